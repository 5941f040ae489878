"""The studio: a page, served to this machine alone, in which mechanisms are drawn, moved and diagnosed."""
