"""Files of programs that calibrate and locate cameras."""
