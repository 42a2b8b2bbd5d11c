"""Names of joints and columns: which column of a log belongs to which signal of a twin."""
