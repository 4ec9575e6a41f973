"""What the views of the workbench show, as plain values: functions of a project in memory, methods of the workbench."""
