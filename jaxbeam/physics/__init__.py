"""Energies: the interface, the materials, and one file for each kind of energy."""
