"""Connections through a router keep what every transport promises, with keys and without."""

from net.test_transport_contract import *  # noqa: F403 - the tests of the contract are the tests of this file
