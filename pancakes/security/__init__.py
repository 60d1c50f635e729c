"""Keys, certificates, rosters and access rules of a fleet."""
