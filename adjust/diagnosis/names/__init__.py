"""Things called by each other's names, and epochs out of order: points, cameras, epochs, the same epoch twice."""
