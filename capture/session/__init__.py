"""A capture from start to end: the cameras and the table of a plan, what they record, and how it is watched."""
