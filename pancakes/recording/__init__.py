"""Recordings: the packets of an agent's channels in MCAP files, which Foxglove opens too.

One packet is one message. Its topic is `/AGENT/CHANNEL/TYPE`, where `AGENT` is the agent on whose channel it was seen;
its data is JSON, with a JSON Schema made from the class of the body.
"""
