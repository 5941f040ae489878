"""The foundation of all machine code: its text, memory and modules, and the way from text to an operation of XLA."""
