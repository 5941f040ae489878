// The numbers of a live page in its address, so that everyone who opens it sees the same motion.

export class Address {
  constructor(live) { this.live = live; }

  /** True if the page has an address of its own, and is not inside another page. */
  get exists() { return Boolean(this.live.player.options.fill) && location.protocol !== "about:"; }

  /** The changed numbers, as the fragment of an address. */
  get fragment() {
    const {data: {sliders}, values} = this.live, changed = sliders.map((s, k) => [s, values[k]]).filter(([s, x]) => x !== s.value);
    return new URLSearchParams(changed.map(([s, x]) => [s.name, String(x)])).toString();
  }

  write() {
    if (this.exists) history.replaceState(null, "", `#${this.fragment}`);
  }

  read() {
    if (!this.exists) return;
    const given = new URLSearchParams(location.hash.slice(1)), numbers = {};
    for (const {name} of this.live.data.sliders) {
      const value = Number(given.get(name));
      if (given.get(name) && Number.isFinite(value)) numbers[name] = value;
    }
    if (Object.keys(numbers).length) this.live.change(numbers);
  }

  async copy() {
    const {live, fragment} = this;
    this.write();
    try {
      await navigator.clipboard.writeText(this.exists ? location.href : `#${fragment}`);
      live.say("A link with these numbers has been copied.");
    } catch {
      live.say(this.exists ? "The address of this page now contains these numbers." : `Changed numbers: ${fragment || "none"}`);
    }
  }
}
