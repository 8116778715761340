#!/usr/bin/env python3
"""Judges what a subscriber received, without a line of cangate's own code.

usage: received.py FILE NEWEST

FILE holds one message a line, as `mosquitto_sub -F '%t %p'` writes them. NEWEST is the number of the newest event of which the
gateway said, elsewhere, that it happened. Every event up to there must be there once or more, first deliveries in order and without a gap; a second delivery
must have the same bytes. The states of each node and run (live or of the history) must have no gap. Prints figures as
JSON; exit code 1 and the reasons where something is wrong.
"""

import collections
import json
import sys


def main(path, newest):
    wrong = []
    events = {}
    last = 0
    sids = []
    doubled = missed = 0
    states = collections.defaultdict(set)
    live = history = 0
    for line in open(path, encoding="utf-8"):
        topic, _, payload = line.rstrip("\n").partition(" ")
        parts = topic.split("/")
        if not payload or len(parts) < 3:
            continue
        if parts[-1] == "event":
            event = json.loads(payload)
            name = (event["sid"], event["seq"])
            if event["name"] == "events_missed":
                missed += event["value"]
                last = event["seq"]
                continue
            if name in events:
                doubled += 1
                if events[name] != payload:
                    wrong.append(f"event {name} came again with other bytes")
                continue
            events[name] = payload
            if event["sid"] not in sids:
                sids.append(event["sid"])
            if event["seq"] != last + 1:
                wrong.append(f"event {event['seq']} after {last}")
            last = event["seq"]
        elif parts[-1] in ("state", "history") and parts[-2] != "bridge":
            state = json.loads(payload)
            if (parts[-1] == "history") != (state.get("historical") is True):
                wrong.append(f"{topic}: historical is {state.get('historical')}")
            live += parts[-1] == "state"
            history += parts[-1] == "history"
            states[(state["sid"], parts[-2])].add(state["seq"])
    if last < newest:
        wrong.append(f"the last event is {last}, the gateway has {newest}")
    gaps = 0
    for (sid, node), numbers in states.items():
        gap = max(numbers) - len(numbers)
        gaps += gap
        if gap:
            lost = sorted(set(range(1, max(numbers) + 1)) - numbers)[:5]
            wrong.append(f"{node} of {sid}: {gap} states are missing: {lost}")
    print(json.dumps({
        "events": len(events), "doubled": doubled, "told_missed": missed, "event_streams": len(sids),
        "live": live, "history": history, "runs": len({sid for sid, _ in states}), "missing_states": gaps,
    }))
    for line in wrong[:20]:
        print(line, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
