"""APEX: the stages of ``solve``, their context and report."""
