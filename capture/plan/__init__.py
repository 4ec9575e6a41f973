"""The capture plan: which cameras and which table take which images."""
