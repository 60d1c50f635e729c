"""Find the agents that announce themselves on the networks of this machine.

An agent announces itself with `mdns = true` in its `[agent]`. On a network without one of the fleet `yard` the
program says so:

$ python examples/find_agents_by_name.py
no agent of the fleet yard announces itself by mDNS on the networks of this machine: start one, or name one with --at
"""

from pancakes import Client, PancakesError

try:
    with Client("mdns:", fleet="yard") as client:
        for agent in client.agents():
            print(agent.agent, "has the tasks", [task.task for task in client.tasks(agent.agent)])
except PancakesError as error:
    print(error)
