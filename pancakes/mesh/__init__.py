"""Links between agents without a broker: wire format, connections, membership, clocks, and what peers may send."""
