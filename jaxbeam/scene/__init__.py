"""Scenes, the reference scenes, measures, and checks of supports and of overlap."""
