"""The latent diffusion model (sections III-B and III-C of the paper): networks, noise, sampling, guidance, training.

It knows torch, NumPy and the kernel; no OMPL and no Pinocchio.
"""
