"""Targets of quite another size than their owner says. Small differences in size and shape are effects."""
