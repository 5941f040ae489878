"""Commands about how a mechanism moves: runs, pages, positions along a drive, clearances."""
