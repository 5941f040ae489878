"""What all machine code stands on: the text, its memory and its modules, and the way from text to an operation of XLA."""
