"""The services that every agent has (device, network, log), and the root that supervises them."""
