"""Sections of the report: functions from a ``Context`` to ``Markup``, one module for each subject."""
