"""How a trace decides: one likelihood with the twin's own discrepancy, one search, one posterior."""
