"""An unrolled network: data steps by Psi itself, and between them a small learned denoiser."""
