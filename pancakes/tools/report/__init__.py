"""Reports: what a recording shows, as a page that needs nothing but itself, and as pictures for a paper.

Packets go through `findings` one by one, in bounded memory; what it finds is plain data. Only `drawing` and what
stands on it need matplotlib.
"""
