"""Generators of network weights, learned and control, behind one interface."""
