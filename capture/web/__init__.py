"""A local web page that shows a session, or what the cameras see now."""
