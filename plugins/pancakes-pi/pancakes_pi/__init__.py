"""Pins, buses and serial lines for Pancakes agents: a Raspberry Pi, a Khepera III, GPS.

What chips, robots and gpsd say is read in pure modules (`registers`, `khepera_lines`, `gps_reports`).
What may be pulled out has a thread that looks for it until it is there again (`khepera_port`, `gps_feed`).
"""
