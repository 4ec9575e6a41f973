"""The mathematics of a photogrammetric survey adjustment: values in, values out."""
