"""NNiT: a diffusion transformer over patches of weights, conditioned on the architecture (NNiT 5)."""
