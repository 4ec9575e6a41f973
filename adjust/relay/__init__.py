"""Relay networks: stations joined by measured relative rotations or poses, adjusted in two equivalent forms."""
