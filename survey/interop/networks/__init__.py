"""Files of programs that adjust networks of readings and of poses."""
