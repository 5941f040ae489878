"""Parts that several studies share, or of long studies."""
