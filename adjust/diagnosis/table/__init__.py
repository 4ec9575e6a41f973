"""Table readings checked against images: swapped axes, signs, units, epochs, mis-detected targets."""
