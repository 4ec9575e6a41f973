"""The jobs behind the commands: each reads a project, does one thing, and writes its results."""
