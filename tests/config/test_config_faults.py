"""What a configuration can get wrong. All of it comes at once, each with its line, its key and what was meant."""

import pytest
from seeded import for_each

from pancakes.config import parse
from pancakes.errors import ConfigError

HEAD = 'schema = 1\n[agent]\nname = "agent1"\n'
"""Three lines that are sound: what the tests add begins on line 4."""


def faults(text: str, sets: list[str] | None = None) -> list[str]:
    with pytest.raises(ConfigError) as error:
        parse(text, "a.toml", sets or [])
    return [str(fault) for fault in error.value.faults]


def test_all_mistakes_come_at_once_in_the_order_of_the_file():
    text = """schema = 1
[agent]
name = "agent1"
rolle = "agent"
[clock]
speed = 0
[device.motors]
driver = "sim.motors"
rate_hz = -10
[task.ScanTarget]
type = "encirclement.ScanTarget"
service = "clinet"
restart = { policy = "permanent", at_most = "three" }
"""
    assert faults(text) == [
        "a.toml:4: [agent] rolle: unknown key, did you mean 'role'?",
        "a.toml:6: [clock] speed: expected a number > 0, not 0",
        "a.toml:9: [device.motors] rate_hz: expected a number >= 0, not -10",
        "a.toml:12: [task.ScanTarget] service: there is no service 'clinet', did you mean 'client'?",
        (
            "a.toml:13: [task.ScanTarget] restart.policy: expected one of 'no', 'on-failure', 'always',"
            " not 'permanent', did you mean 'always'?"
        ),
        "a.toml:13: [task.ScanTarget] restart.at_most: expected an integer, got a string",
    ]


def test_key_of_an_inner_table_is_named_with_its_table():
    head = 'schema = 1\n[agent]\nname = "agent1"\n[task.Walk]\ntype = "test.Walk"\n'
    assert faults(head + 'restart = "always"\n') == [
        'a.toml:6: [task.Walk] restart: expected a table, got a string: write restart = { policy = "always" }'
    ]
    assert faults(head + "guard = 3\nlease_s = 2.0\nat_most = 3\nagain_s = 5.0\n") == [
        "a.toml:6: [task.Walk] guard: expected a table or nothing, got an integer: write guard = { copies = 3 }",
        ("a.toml:7: [task.Walk] lease_s: unknown key; it belongs in the table `guard`, did you mean 'guard.lease_s'?"),
        (
            "a.toml:8: [task.Walk] at_most: unknown key; it belongs in the table `restart`,"
            " did you mean 'restart.at_most'?"
        ),
        "a.toml:9: [task.Walk] again_s: unknown key; the task's own settings belong in its key `settings`",
    ]


def test_an_empty_file_lacks_the_schema_and_the_name():
    assert faults("") == [
        "a.toml: schema: is missing: write schema = 1",
        "a.toml: [agent] name: is missing",
    ]


@pytest.mark.parametrize(
    ("schema", "problem"),
    [
        ("2", "the format 2 is not known to this version, which reads 1"),
        ('"1"', "expected an integer, not '1'"),
        ("true", "expected an integer, not True"),
    ],
)
def test_only_the_format_that_this_version_knows_is_read(schema: str, problem: str):
    assert faults(HEAD.replace("schema = 1", f"schema = {schema}")) == [f"a.toml:1: schema: {problem}"]


def test_unknown_config_keys_at_any_depth():
    def check(case):
        text, expected = case
        assert faults(HEAD + text) == expected

    for_each(
        [
            ("[tasks.X]\n", ["a.toml:4: [tasks]: unknown table, did you mean 'task'?"]),
            ("[clock]\nspede = 2\n", ["a.toml:5: [clock] spede: unknown key, did you mean 'speed'?"]),
            (
                "[task.X]\ntype = 'x'\nrestart = { at_least = 1 }\n",
                ["a.toml:6: [task.X] restart.at_least: unknown key, did you mean 'at_most'?"],
            ),
            (
                "[task.X]\ntype = 'x'\n[task.X.migrate]\nwhen = 'battery'\nbelow = 0.5\nelse = 1\n",
                ["a.toml:9: [task.X] migrate.else: unknown key"],
            ),
            (
                "[service.network]\ndiscovery_hz = 1\n",
                [
                    (
                        "a.toml:5: [service.network] discovery_hz: unknown key;"
                        " the service's own settings belong in its key `settings`"
                    )
                ],
            ),
            (
                "[task.X]\ntype = 'x'\nname = 'Y'\n",
                ["a.toml:6: [task.X] name: unknown key; the name belongs in the head of the table: [task.NAME]"],
            ),
            ("[channel.images]\nsize = 3\n", ["a.toml:5: [channel.images] size: unknown key"]),
        ],
        check,
    )


def test_an_unknown_key_at_the_top():
    assert faults("shcema = 1\n" + HEAD) == ["a.toml:1: shcema: unknown key, did you mean 'schema'?"]


def test_config_value_of_wrong_type_or_range():
    def check(case):
        text, expected = case
        assert faults(HEAD + text) == [expected]

    for_each(
        [
            ("[clock]\nspeed = nan\n", "a.toml:5: [clock] speed: is not a number (nan)"),
            ("[clock]\nspeed = true\n", "a.toml:5: [clock] speed: expected a number, got true or false"),
            ("[clock]\nhold = 1\n", "a.toml:5: [clock] hold: expected true or false, got an integer"),
            ("[device.d]\ndriver = 1\n", "a.toml:5: [device.d] driver: expected a string, got an integer"),
            (
                "[device.d]\ndriver = 'x'\nsettings = 1\n",
                "a.toml:6: [device.d] settings: expected a table, got an integer",
            ),
            ("[device.d]\nrate_hz = 1\n", "a.toml:4: [device.d] driver: is missing"),
            (
                "[record]\ntask = 'Saver'\n",
                "a.toml:4: [record]: task: 'Saver' is no task id: it must read birthplace/name",
            ),
            (
                "[device.d]\ndriver = 'x'\nrate_hz = 100000000000000000000\n",
                f"a.toml:6: [device.d] rate_hz: lies beyond what can be saved ({-(2**63)} to {2**64 - 1})",
            ),
            ("[device.d]\ndriver = ''\n", "a.toml:5: [device.d] driver: is empty"),
            ("[service.vision]\ntype = ''\n", "a.toml:5: [service.vision] type: is empty"),
            ("[task.X]\ntype = ''\n", "a.toml:5: [task.X] type: is empty"),
            ("[service.vision]\n", "a.toml:4: [service.vision] type: is missing"),
            ("[task.X]\n", "a.toml:4: [task.X] type: is missing"),
            (
                "[task.X]\ntype = 'x'\nrestart = { within_s = 0 }\n",
                "a.toml:6: [task.X] restart.within_s: expected a number of seconds > 0, not 0",
            ),
            (
                "[task.X]\ntype = 'x'\nrestart = { within_s = inf }\n",
                "a.toml:6: [task.X] restart.within_s: is not finite (inf)",
            ),
            (
                "[service.log]\nrestart = { at_most = -1 }\n",
                "a.toml:5: [service.log] restart.at_most: expected an integer >= 0, not -1",
            ),
            (
                "[task.X]\ntype = 'x'\nrestart = { pause_s = -1 }\n",
                "a.toml:6: [task.X] restart.pause_s: expected a number of seconds >= 0, not -1",
            ),
            (
                "[device.X]\ndriver = 'x'\nrestart = { again_s = -0.5 }\n",
                "a.toml:6: [device.X] restart.again_s: expected a number of seconds >= 0, not -0.5",
            ),
            (
                "[device.X]\ndriver = 'x'\nrestart = { pause_s = 30 }\n",
                "a.toml:6: [device.X] restart.pause_max_s: is 10 s, less than the first pause (pause_s), which is 30 s",
            ),
            ("[task]\ntype = 'x'\n", "a.toml:5: [task.type]: expected a table with a name, such as [task.NAME]"),
            ("[[task]]\ntype = 'x'\n", "a.toml:4: [task]: expected tables with a name each, such as [task.NAME]"),
            ("[channel.system]\n", "a.toml:4: [channel.system]: the channel 'system' is a core one and always there"),
        ],
        check,
    )


def test_infinity_is_no_rate():
    assert faults(HEAD + "[device.d]\ndriver = 'x'\nrate_hz = inf\n") == [
        "a.toml:6: [device.d] rate_hz: is not finite (inf)"
    ]


def test_bad_task_name_gets_a_suggestion():
    def check(case):
        name, near = case
        (fault,) = faults(HEAD + f"[task.'{name}']\ntype = 'x'\n")

        assert fault.startswith("a.toml:4: [task.")
        assert f"{name!a} is not a name: a name has letters from a to z and A to Z, digits, '_' and '-'" in fault
        assert fault.endswith(f"did you mean {near!r}?")

    for_each(
        [
            ("go home", "go_home"),
            ("a/b", "a_b"),
            ("*", "_"),
            (".x", "x"),
            ("a.b", "a_b"),
            ("-b", "b"),
            ("grün", "gr_n"),
        ],
        check,
    )


def test_agents_and_fleets_have_names_too():
    text = 'schema = 1\n[agent]\nname = ""\nfleet = "a b"\n'

    first, second = faults(text)
    assert first.startswith("a.toml:3: [agent] name: '' is not a name")
    assert second.startswith("a.toml:4: [agent] fleet: 'a b' is not a name")


def test_a_long_name_is_refused():
    (fault,) = faults(HEAD + f"[task.{'x' * 65}]\ntype = 'x'\n")
    assert "at most 64 long" in fault


def test_a_task_of_the_device_service_needs_a_name_of_its_own():
    text = HEAD + "[device.pose]\ndriver = 'x'\n[task.pose]\ntype = 'x'\nservice = 'device'\n"
    assert faults(text) == [
        "a.toml:6: [task.pose]: has the same address as [device.pose]: give one of them another name"
    ]


class TestAddresses:
    def test_each_peer_is_checked(self):
        text = (
            HEAD
            + """peers = [
    "tcp://10.0.0.1:7401",
    "127.0.0.1:7401",
    "tcp://10.0.0.1:0",
    "tcp://10.0.0.1:7401",
]
"""
        )
        assert faults(text) == [
            "a.toml:6: [agent] peers[1]: '127.0.0.1:7401' is no address: write it as tcp://host:port",
            "a.toml:7: [agent] peers[2]: 'tcp://10.0.0.1:0' has the port 0, at which no agent can be reached",
            "a.toml:8: [agent] peers[3]: 'tcp://10.0.0.1:7401' is in the list twice",
        ]

    def test_an_address_of_one_network_needs_its_interface(self):
        text = HEAD + 'listen = "tcp://[fe80::1]:7401"\npeers = ["tcp://[fe80::2]:7401", "tcp://[fe80::2%eth0]:7401"]\n'
        with pytest.raises(ConfigError) as error:
            parse(text, "a.toml")
        assert [fault.key for fault in error.value.faults] == ["[agent] listen", "[agent] peers[0]"]
        assert "write [fe80::2%eth0], with a name that ip link shows" in error.value.faults[1].problem

    def test_its_own_address_may_stand_among_the_peers_so_that_a_fleet_shares_one_list(self):
        text = HEAD + 'listen = "tcp://127.0.0.1:7401"\npeers = ["tcp://127.0.0.1:7401", "tcp://127.0.0.1:7402"]\n'
        assert parse(text, "a.toml").agent.peers == ("tcp://127.0.0.1:7401", "tcp://127.0.0.1:7402")

    def test_a_bad_address_to_listen_at(self):
        assert faults(HEAD + 'listen = "tcp://127.0.0.1:"\n') == [
            "a.toml:4: [agent] listen: 'tcp://127.0.0.1:' has no port: write it as tcp://host:port"
        ]

    def test_address_without_a_port_has_the_default_one(self):
        config = parse(HEAD + 'listen = "tcp://0.0.0.0"\npeers = ["tcp://robot2", "tcp://[::1]"]\n', "a.toml")
        assert config.agent.listen == ("tcp://0.0.0.0:7401",)
        assert config.agent.peers == ("tcp://robot2:7401", "tcp://[::1]:7401")


class TestMigrationRules:
    def rule(self, rule: str) -> list[str]:
        return faults(HEAD + f"[task.X]\ntype = 'x'\nmigrate = {rule}\n[task.GoHome]\ntype = 'x'\n")

    def test_migration_rule_faults(self):
        def check(case):
            rule, key, problem = case
            (fault,) = self.rule(rule)
            assert fault.startswith(f"a.toml:6: [task.X] {key}: {problem}")

        for_each(
            [
                ("{ below = 0.5 }", "migrate.when", "is missing"),
                ("{ when = '', below = 0.5 }", "migrate.when", "is empty"),
                ("{ when = 'battery' }", "migrate", "needs a bound: below, above or both"),
                ("{ when = 'battery', below = 65 }", "migrate.below", "expected a number from 0 to 1"),
                ("{ when = 'battery', above = -1 }", "migrate.above", "expected a number from 0 to 1"),
                ("{ when = 'battery', below = nan }", "migrate.below", "is not a number (nan)"),
                ("{ when = 'x', field = 'celsius', above = inf }", "migrate.above", "is not finite (inf)"),
                ("{ when = 'battery', below = 0.5, above = 0.4 }", "migrate.below", "is more than above (0.4)"),
                ("{ when = 'battery', below = 0.5, then = 'X' }", "migrate.then", "names the task itself"),
                ("{ when = 'battery', below = 0.5, cost = '' }", "migrate.cost", "is empty"),
                ("{ when = 'battery', below = 0.5, cost = {} }", "migrate.cost", "names no cost function"),
                (
                    "{ when = 'battery', below = 0.5, cost = { tasks = -1 } }",
                    "migrate.cost.tasks",
                    "a weight is a finite number of at least 0, not -1",
                ),
                (
                    "{ when = 'battery', below = 0.5, cost = { tasks = 1, load = inf } }",
                    "migrate.cost.load",
                    "is not finite (inf)",
                ),
                (
                    "{ when = 'battery', below = 0.5, cost = { tasks = nan } }",
                    "migrate.cost.tasks",
                    "is not a number (nan)",
                ),
            ],
            check,
        )

    def test_what_follows_is_a_task_of_this_agent(self):
        assert self.rule("{ when = 'battery', below = 0.5, then = 'GoHom' }") == [
            "a.toml:6: [task.X] migrate.then: there is no task 'GoHom' here, did you mean 'GoHome'?"
        ]

    def test_the_bounds_of_other_fields_are_theirs(self):
        text = HEAD + "[task.X]\ntype = 'x'\nmigrate = { when = 'temperature', field = 'celsius', above = 70 }\n"
        rule = parse(text, "a.toml").tasks["X"].migrate
        assert rule is not None and rule.above == 70


class TestSyntax:
    """A line that is not TOML hides nothing that does not depend on it."""

    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("schema = 1\n[agent\n", "a.toml:2: TOML: expected ']' at the end of a table declaration"),
            ("schema = 1\nx = [1,\n2 3]", "a.toml:3: TOML: unclosed array"),
            ("schema = 1\nx = [1,\n[clock]\n", "a.toml:3: TOML: invalid value"),
            ("x = " + "[" * 100_000, "a.toml: TOML: is nested too deeply"),
        ],
    )
    def test_what_depends_on_the_line_is_not_judged(self, text: str, expected: str):
        assert faults(text) == [expected]

    @pytest.mark.parametrize(
        ("line", "expected"),
        [
            ("x = \n", "[clock] x: invalid value"),
            ("[task.X]\n\n[task.X]\nfoo = 1\n", "[task.X]: the table is defined twice"),
            ("speed = 2\nspeed = 3\n", "TOML: a key is defined twice"),
            ("x = True\n", "[clock] x: True is not TOML: write true"),
            ("x = yes  # it is\n", "[clock] x: yes is not TOML: write true, or the word in quotes"),
            ("x = None\n", "[clock] x: None is not TOML: leave the key out"),
            ("x = NaN\n", "[clock] x: is not a number (NaN)"),
            ("period_s = 500ms\n", "[clock] period_s: 500ms is not TOML: write period_s = 0.5"),
            ("x = tcp://a:1\n", '[clock] x: tcp://a:1 is not TOML: write text in quotes, as in x = "tcp://a:1"'),
            ('x = "a\n', "[clock] x: illegal character '\\n'"),
        ],
    )
    def test_a_value_that_is_no_toml_is_told_with_the_rest(self, line: str, expected: str):
        found = faults(f"{HEAD}[clock]\n{line}[task.Y]\ntyp = 'x'\n")
        assert [it.partition(" ")[2] for it in found if ": unknown" not in it and "is missing" not in it] == [expected]
        assert any("[task.Y] typ: unknown key, did you mean 'type'?" in it for it in found)

    def test_all_of_them_come_at_once(self):
        text = (
            HEAD
            + """rolle = "agent"
[clock]
speed = 2 x
hold = True
[device.load]
driver = host.load
rate_hz = 2 Hz
[task.X]
type = "x"
rate_hz = "500ms"
settings = { radius_m = NaN }
[task.X]
type = "y"
[task.Y]
type = "y"
period = "0.5 s"
"""
        )
        assert faults(text) == [
            "a.toml:4: [agent] rolle: unknown key, did you mean 'role'?",
            "a.toml:6: [clock] speed: expected newline or end of document after a statement",
            "a.toml:7: [clock] hold: True is not TOML: write true",
            'a.toml:9: [device.load] driver: host.load is not TOML: write text in quotes, as in driver = "host.load"',
            "a.toml:10: [device.load] rate_hz: 2 Hz is not TOML: write rate_hz = 2",
            "a.toml:13: [task.X] rate_hz: expected a number or nothing, got a string: write rate_hz = 2",
            "a.toml:14: [task.X] settings: invalid value",
            "a.toml:15: [task.X]: the table is defined twice",
            "a.toml:19: [task.Y] period: unknown key, did you mean 'rate_hz = 2'?",
        ]
