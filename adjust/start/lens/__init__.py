"""Start values of the lens of one camera from its images of known points."""
