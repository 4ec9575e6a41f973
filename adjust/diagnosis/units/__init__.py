"""Numbers read in another unit, sign, sense or convention than they were written in: readings, given values, pairs."""
