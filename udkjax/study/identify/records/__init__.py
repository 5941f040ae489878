"""Measurements: records from files, tables and arrays, with the mistakes of each by file, row and column."""
