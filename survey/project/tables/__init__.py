"""The tables in ``observations/``: their columns, readers and writers."""
