"""MQTT for Pancakes agents: devices behind a broker as drivers, channels as topics, topics as packets.

`BrokerConnection` is one thread with one connection to one broker; the drivers of an agent share one, the service has
its own. What goes in and out is decided in pure modules: `topics`, `payloads`, `forms`, `refusals`, `spool`.
"""
