// Updates of symbols when numbers of the scene change (udkjax/show/player/marks/symbol_updates.py).

/** Updates the symbols, marks and traces of a run from the numbers of the scene. */
export class SymbolUpdater {
  constructor(run, rows) {
    this.run = run;
    this.rows = rows;
    run.symbols = structuredClone(run.symbols);
    run.marks = structuredClone(run.marks);
    run.traces = structuredClone(run.traces);
    run.arrows = structuredClone(run.reactions);
    run.placed = run.measures.map(measure => structuredClone(measure.anchors));
    this.whole = rows.sizes.map(([k]) => structuredClone(run.symbols[k]));
  }

  update(numbers) {
    const {run, rows} = this, put = (anchor, start, x, y) => { anchor[start] = numbers[x]; anchor[start + 1] = numbers[y]; };
    for (const [k, which, x, y] of rows.frames) put(which < 0 ? run.symbols[k].frame : run.symbols[k].frame[which], 1, x, y);
    for (const [k, row, x, y] of rows.points) put(run.symbols[k].points[row], 0, x, y);
    for (const [k, , x, y] of rows.traces) put(run.traces[k], 1, x, y);
    for (const [k, , x, y] of rows.arrows) put(run.arrows.anchors[k], 1, x, y);
    for (const [k, which, x, y] of rows.measures ?? []) put(run.placed[k][which], 1, x, y);
    for (const [k, , x, y] of rows.pins) run.marks[k].at = [numbers[x], numbers[y]];
    for (const [k, place] of rows.angles) run.symbols[k].frame[3] = numbers[place];
    rows.sizes.forEach(([k, place, radius], i) => {
      const scale = numbers[place] / radius, {points, radius: size} = this.whole[i];
      if (points) run.symbols[k].points = points.map(([x, y, ...rest]) => [x * scale, y * scale, ...rest]);
      if (size) run.symbols[k].radius = [size[0] * scale, size[1], size[2]];
    });
    run.paths = null;
  }
}
