"""A laboratory that is not there: images of known truth, served as real cameras would."""
