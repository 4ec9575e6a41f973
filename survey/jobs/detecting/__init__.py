"""The job ``detect``: the images of a project looked at, their tables written, and images that are wrong as such."""
