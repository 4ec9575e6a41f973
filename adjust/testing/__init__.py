"""Statistical testing without a survey.

Distributions by SciPy's names, levels and critical values, tests of many observations at once, and the one search for
gross errors as values. What is tested, and on which graph, does not belong here.
"""
