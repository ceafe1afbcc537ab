"""The page, the baseline, the alert rules and the dashboard name the same metrics; promtool checks all of them."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import pytest
import yaml
from metrics_parts import DOCKER, ROOT, baseline, families, program, used_names

PAGE = (ROOT / "docs/metrics.md").read_text()


def promtool(*arguments: str | Path, text: str = "") -> None:
    done = subprocess.run([program("promtool"), *arguments], input=text, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_page_has_the_names_types_and_labels_of_the_baseline() -> None:
    rows = re.findall(r"^\| `(tensormass_\w+)` \| (\w+) \|([\w, ]*)\|", PAGE, re.MULTILINE)
    page = {
        name: (kind, {label.strip() for label in labels.split(",") if label.strip()}) for name, kind, labels in rows
    }
    made = {name: (each.kind, set(each.labels) - {"le"}) for name, each in families(baseline()).items()}
    assert page == made
    assert len(rows) == len(page)


def test_the_page_has_every_value_of_labels_that_are_lists() -> None:
    made = families(baseline())
    values = {
        "reason` | the first bound": made["tensormass_faults_total"].labels["reason"],
        "reason` | what a transport": made["tensormass_bus_refusals_total"].labels["reason"],
        "limit`": made["tensormass_refusals_total"].labels["limit"],
    }
    for head, expected in values.items():
        table = PAGE.split(f"| `{head}")[1].split("\n\n")[0]
        first_cells = [row.split("|")[1] for row in table.splitlines()[2:]]
        assert set(re.findall(r"`(\w+)`", " ".join(first_cells))) == expected
    for name, label in (
        ("scene_state", "state"),
        ("poses_total", "outcome"),
        ("frames_total", "outcome"),
        ("bus_refusals_total", "transport"),
        ("recording_losses_total", "what"),
    ):
        row = next(line for line in PAGE.splitlines() if line.startswith(f"| `tensormass_{name}`"))
        assert made[f"tensormass_{name}"].labels[label] <= set(re.findall(r"`(\w+)`", row))


def test_the_page_has_the_buckets() -> None:
    listed = re.search(r"histograms end at ([\d., and]+) s\.", PAGE.replace("\n", " "))
    assert listed
    bounds = {float(bound) for bound in re.findall(r"\d+(?:\.\d+)?", listed[1])}
    for name, family in families(baseline()).items():
        if family.kind == "histogram":
            assert {float(bound) for bound in family.labels["le"]} == bounds | {float("inf")}, name


def test_promtool_accepts_names_and_text() -> None:
    promtool("check", "metrics", text=baseline())


def test_promtool_accepts_rules_and_configuration() -> None:
    promtool("check", "rules", DOCKER / "prometheus-alerts.yaml")
    promtool("check", "config", DOCKER / "prometheus.yaml")


@pytest.mark.parametrize("file", ["prometheus-alerts.yaml", "grafana-dashboard.json"])
def test_rules_and_dashboard_ask_for_metrics_that_there_are(file: str) -> None:
    names = set(used_names((DOCKER / file).read_text()))
    assert len(names) > 5
    assert names <= set(families(baseline()))


@pytest.mark.parametrize("file", ["prometheus-alerts.yaml", "grafana-dashboard.json"])
def test_rules_and_dashboard_ask_for_labels_and_values_that_there_are(file: str) -> None:
    text = (DOCKER / file).read_text().replace('\\"', '"')
    made, asked = families(baseline()), 0
    for name, matchers in re.findall(r"\b(tensormass_\w+)\{([^}]*)\}", text):
        family = made[next(used_names(name))]
        for label, how, value in re.findall(r'(\w+)(=~|!=|=)"([^"]*)"', matchers):
            # Prometheus adds the instance. What begins with $ is a variable of the dashboard.
            assert label in family.labels or label == "instance", f"{name} has no label {label}"
            if not value.startswith("$"):
                assert how != "=~", "this test compares whole values"
                assert value in family.labels[label], f"{name} has no {label} {value}"
                asked += 1
    assert asked > 0


def test_the_dashboard_shows_every_metric() -> None:
    shown = set(used_names((DOCKER / "grafana-dashboard.json").read_text()))
    assert set(families(baseline())) - shown <= {
        "tensormass_gateway_daemon_up",
        "tensormass_gateway_browsers_limit",
        "tensormass_gateway_malformed_messages_total",
    }


def test_expressions_of_the_dashboard_are_valid(tmp_path: Path) -> None:
    """promtool reads them as rules, after Grafana's variables are replaced."""
    dashboard = json.loads((DOCKER / "grafana-dashboard.json").read_text())
    expressions = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    variables = {"$__rate_interval": "1m", "$instance": ".+", "$scene": ".+"}
    rules = []
    for number, expression in enumerate(expressions):
        for variable, value in variables.items():
            expression = expression.replace(variable, value)
        rules.append({"record": f"panel_{number}", "expr": expression})
    file = tmp_path / "rules.yaml"
    file.write_text(yaml.safe_dump({"groups": [{"name": "dashboard", "rules": rules}]}))
    promtool("check", "rules", file)
    places = [(p["gridPos"]["x"], p["gridPos"]["y"]) for p in dashboard["panels"]]
    assert len(set(places)) == len(places)


def series(name: str, values: str, **labels: str) -> dict[str, str]:
    written = ", ".join(f'{label}="{value}"' for label, value in labels.items())
    return {"series": f"{name}{{{written}}}", "values": values}


#: Series of a minute each, the alert that they must raise, and after how long [min].
ALERTS = [
    ("TensormassDown", [series("up", "0x9", job="tensormass")], 3),
    ("TensormassDaemonLost", [series("tensormass_gateway_daemon_up", "0x9")], 3),
    ("TensormassSceneStopped", [series("tensormass_scene_state", "1x9", scene="a", state="faulted")], 1),
    (
        "TensormassMissedDeadlines",
        [
            series("tensormass_missed_deadlines_total", "0+600x30", scene="a"),
            series("tensormass_step_duration_seconds_count", "0+6000x30", scene="a"),
        ],
        20,
    ),
    (
        "TensormassSlowForces",
        [
            series("tensormass_pose_to_force_seconds_bucket", "0+90x30", scene="a", le="0.005"),
            series("tensormass_pose_to_force_seconds_bucket", "0+100x30", scene="a", le="0.05"),
            series("tensormass_pose_to_force_seconds_bucket", "0+100x30", scene="a", le="+Inf"),
        ],
        20,
    ),
    (
        "TensormassStalePoses",
        [
            series("tensormass_pose_age_seconds_bucket", "0+90x30", scene="a", le="0.05"),
            series("tensormass_pose_age_seconds_bucket", "0+100x30", scene="a", le="0.2"),
            series("tensormass_pose_age_seconds_bucket", "0+100x30", scene="a", le="+Inf"),
        ],
        20,
    ),
    ("TensormassRecoveries", [series("tensormass_recoveries_total", "0+1x30", scene="a", reason="move")], 20),
    (
        "TensormassMemory",
        [series("tensormass_memory_bytes", "95x30"), series("tensormass_memory_limit_bytes", "100x30")],
        20,
    ),
    ("TensormassRefusals", [series("tensormass_refusals_total", "0+5x30", limit="role")], 20),
    (
        "TensormassBusRefusals",
        [series("tensormass_bus_refusals_total", "0+5x30", transport="zenoh", reason="access")],
        20,
    ),
    (
        "TensormassFullQueues",
        [series("tensormass_bus_full_queues_total", "0+2x30", transport="zeromq", stream="feedback")],
        20,
    ),
    ("TensormassRecordingLosses", [series("tensormass_recording_losses_total", "0+1x30", scene="a", what="steps")], 20),
]


def alerts() -> list[str]:
    groups = yaml.safe_load((DOCKER / "prometheus-alerts.yaml").read_text())["groups"]
    return [rule["alert"] for group in groups for rule in group["rules"]]


def test_every_alert_is_raised_in_a_test() -> None:
    assert [name for name, _, _ in ALERTS] == alerts()


def test_alerts_are_raised_and_not_before(tmp_path: Path) -> None:
    """Raised from invented series, and silent without them: PromQL's `ALERTS` counts those that fire."""
    tests = []
    for name, inputs, minutes in ALERTS:
        firing = f'count(ALERTS{{alertname="{name}", alertstate="firing"}})'
        tests.append(
            {
                "interval": "1m",
                "input_series": inputs,
                "promql_expr_test": [
                    {"expr": firing, "eval_time": f"{minutes}m", "exp_samples": [{"labels": "{}", "value": 1}]},
                    {
                        "expr": 'count(ALERTS{alertstate="firing"})',
                        "eval_time": f"{minutes}m",
                        "exp_samples": [{"labels": "{}", "value": 1}],
                    },
                ],
            }
        )
    tests.append(
        {
            "interval": "1m",
            "input_series": [
                series(name, "0x30", scene="a", state="faulted", job="a") for name in used_names_of_rules()
            ],
            "promql_expr_test": [
                {
                    "expr": 'count(ALERTS{alertstate="firing", alertname!="TensormassDaemonLost"})',
                    "eval_time": "20m",
                    "exp_samples": [],
                }
            ],
        }
    )
    file = tmp_path / "test.yaml"
    rules = [str(DOCKER / "prometheus-alerts.yaml")]
    file.write_text(yaml.safe_dump({"rule_files": rules, "evaluation_interval": "1m", "tests": tests}))
    promtool("test", "rules", file)


def used_names_of_rules() -> list[str]:
    return sorted(set(used_names((DOCKER / "prometheus-alerts.yaml").read_text())))
