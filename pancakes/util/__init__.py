"""Helpers below everything else: encoding, checks of users' classes, text, clocks, files, plug-ins."""
