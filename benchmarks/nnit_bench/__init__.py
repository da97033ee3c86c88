"""Score generators of neural-network weights on the tasks of nnit_zoo."""
