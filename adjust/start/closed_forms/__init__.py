"""Solutions without a start: pure functions of arrays, each with the source of its formula."""
