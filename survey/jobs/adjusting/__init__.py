"""The job ``adjust``: what is asked for, the adjustment, and what the images say about its failures."""
