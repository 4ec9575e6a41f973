"""What earlier adjustments of a project left: their results, the runs that are kept, and what changed since."""
