"""Pytrees, compilation, derivative rules, and checks of arguments."""
