"""Energies: the contract, materials, and one file for each kind."""
