"""Filters: what stands between a task's commands and an actuator (docs/filters.md).

A command to an actuator passes the filters of its device, one after the other, on the robot that has the device. They
are no part of a task, so they stay when a task migrates, is taken over, or computes nonsense. `filter` has the base
class, `chain` runs the filters of one actuator, `limit` and `barrier` are the two that come with Pancakes.
"""
