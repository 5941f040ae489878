"""The contrast of all text of a page in a browser."""

LEAST_CONTRAST = 4.5  # of text, by WCAG 2 (3 for large text)
# The text with the least ratio of contrast to what it needs.
CONTRAST = """() => {
    const parsed = text => {
        const found = text.match(/[\\d.]+/g)?.map(Number) ?? [0, 0, 0, 0];
        const full = text.startsWith("color(srgb") ? 255 : 1;
        return [...found.slice(0, 3).map(x => full * x), found[3] ?? 1];
    };
    const over = (front, back) => [0, 1, 2].map(k => front[3] * front[k] + (1 - front[3]) * back[k]);
    const light = c => [0.2126, 0.7152, 0.0722].reduce((sum, part, k) => {
        const s = c[k] / 255;
        return sum + part * (s <= 0.04045 ? s / 12.92 : ((s + 0.055) / 1.055) ** 2.4);
    }, 0);
    const behind = element => {
        const layers = [];
        for (let e = element; e; e = e.parentElement) layers.push(parsed(getComputedStyle(e).backgroundColor));
        const paper = matchMedia("(prefers-color-scheme: dark)").matches ? 19 : 255;
        return layers.reverse().reduce((back, layer) => over(layer, back), [paper, paper, paper]);
    };
    let least = {ratio: 99};
    const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walk.nextNode()) {
        const e = walk.currentNode.parentElement, style = getComputedStyle(e);
        const said = walk.currentNode.textContent.trim(), rect = e.getBoundingClientRect();
        if (!said || rect.width < 2 || rect.height < 2) continue;
        if (!e.checkVisibility({opacityProperty: true, visibilityProperty: true})) continue;
        const size = parseFloat(style.fontSize), back = behind(e);
        const front = over(parsed(e instanceof SVGElement ? style.fill : style.color), back);
        const [low, high] = [light(front), light(back)].sort((a, b) => a - b);
        const large = size >= 24 || (size >= 18.6 && style.fontWeight >= 700);
        const ratio = (high + 0.05) / (low + 0.05) * (large ? 1.5 : 1);
        if (ratio < least.ratio) least = {ratio, text: said.slice(0, 40), of: `${e.tagName}.${e.className}`};
    }
    return least;
}"""
