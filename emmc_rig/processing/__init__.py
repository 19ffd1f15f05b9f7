"""Sessions and folders of frames to results: whiteboards to Psi, frames and Psi to light fields."""
