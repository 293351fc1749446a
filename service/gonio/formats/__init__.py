"""One module per file format: the only place where foreign units, axes and names exist."""
