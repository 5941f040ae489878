"""Commands that write solutions as one does by hand: one position, one state, exercises for students."""
