"""Planning: what a survey will tell before it is measured, what to measure next, and how exact it has to be."""
