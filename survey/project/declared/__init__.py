"""``survey.toml``: its tables as they are declared, read and written, key by key."""
