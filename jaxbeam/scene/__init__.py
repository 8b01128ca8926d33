"""A scene and what is measured on it; the reference scenes; what holds a body; overlap."""
