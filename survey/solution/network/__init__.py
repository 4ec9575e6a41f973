"""The measured pairs of a solution as a network: what they can tell, how their loops close, and each by itself."""
