"""Make reports of recordings: one self-contained HTML page, and pictures for a paper.

Packets go through `findings` one by one, in bounded memory; the result is plain data. Only `plots` needs matplotlib.
"""
