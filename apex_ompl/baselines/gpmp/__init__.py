"""GPMP and GPMP2: trajectory optimization on a Gaussian-process prior (Mukadam et al. 2018)."""
