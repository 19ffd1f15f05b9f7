"""What Psi allows before anything is reconstructed: errors to be expected, bounds, conditioning."""
