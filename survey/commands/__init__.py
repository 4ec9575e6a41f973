"""The commands of ``labsurvey``: each module declares its arguments and runs the job. Heavy imports happen inside."""
