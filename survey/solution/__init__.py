"""What an adjustment says, as plain values: the dictionary of ``solution.json``, residual tables, and the verdict."""
