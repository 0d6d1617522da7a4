"""The compiled kernel: clearance, its gradient and proofs of freedom over flat arrays, without Pinocchio or Coal."""
