"""Simulation on a CPU: many SAPIEN scenes stepped in lockstep, each built afresh for its episode."""
