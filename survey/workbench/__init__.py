"""The workbench: a project kept in memory, adjusted again at every decision, and served to a browser on this machine.

Here belong the resident session (:class:`survey.workbench.session.Workbench`, public as ``survey.Workbench``), what its
views show as plain values, and the local server of ``labsurvey open``. What an observation means, how it is left out
and how a project is adjusted is decided in the rooms below. Nothing here is imported by another command.
"""
