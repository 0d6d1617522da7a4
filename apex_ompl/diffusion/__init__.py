"""The latent diffusion model (sections III-B and III-C of the paper): networks, noise, sampling, guidance, training.

It imports torch, NumPy and the kernel; neither OMPL nor Pinocchio.
"""
