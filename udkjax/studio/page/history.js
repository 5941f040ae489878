// Undo and redo. States are immutable, so each entry is the state itself and is restored to the bit.

const MOST_ENTRIES = 1000;

export class History {
  constructor(state) { this.reset(state); }

  reset(state) {
    this.states = [state];
    this.at = 0;
  }

  get state() { return this.states[this.at]; }
  get canUndo() { return this.at > 0; }
  get canRedo() { return this.at < this.states.length - 1; }

  /** Add a state and drop the undone ones; returns false, and adds nothing, if it equals the current state. */
  push(state, same = (a, b) => a === b) {
    if (same(state, this.state)) return false;
    this.states = [...this.states.slice(Math.max(0, this.at + 2 - MOST_ENTRIES), this.at + 1), state];
    this.at = this.states.length - 1;
    return true;
  }

  undo() { if (this.canUndo) this.at--; return this.state; }
  redo() { if (this.canRedo) this.at++; return this.state; }
}
