"""Many project folders or epochs in one go: in processes or on a Dask cluster, past failures, with an overview.

``labsurvey adjust FOLDER...`` and :func:`survey.adjust_many` are this package.
"""
