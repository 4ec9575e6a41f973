"""Several epochs: adjusted together, compared by congruence, and what moved between them."""
