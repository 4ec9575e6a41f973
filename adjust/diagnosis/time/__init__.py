"""Things that were not there at the same time, or did not stay where the project says."""
