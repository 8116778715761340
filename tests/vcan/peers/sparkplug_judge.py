"""A host application that judges an edge node of Sparkplug B, by pysparkplug: its decoder, its protobuf messages.

    sparkplug_judge.py PORT GROUP EDGE_NODE

Says `ready` once it is subscribed, then each message as one JSON line: kind, device, seq, bdseq, metrics as
name -> [value, quality, historical, timestamp], and `wrong`, a list of what the specification forbids. Takes lines:

    rebirth                   asks for births
    dcmd DEVICE NAME [NUMBER] writes true, or a number, by alias where a birth told one
    state ID online|offline   what a primary host says, retained
"""

import json
import sys
import time

import pysparkplug as spb
from paho.mqtt import client as mqtt
from pysparkplug import _protobuf as protobuf

KINDS = {
    "NBIRTH": spb.NBirth, "NDATA": spb.NData, "NDEATH": spb.NDeath,
    "DBIRTH": spb.DBirth, "DDATA": spb.DData, "DDEATH": spb.DDeath,
}


class Judge:
    def __init__(self):
        self.seq = None
        self.bdseq = None
        self.births = {}
        self.aliases = {}

    def message(self, kind, device, message):
        raw = protobuf.Payload.FromString(message.payload)
        wrong = []

        def must(condition, what):
            if not condition:
                wrong.append(what)

        must(message.qos == (1 if kind == "NDEATH" else 0), f"{kind} has qos {message.qos}")
        must(not message.retain, f"{kind} is retained")
        must(raw.HasField("timestamp"), "no timestamp")
        if kind == "NDEATH":
            return self.death(raw, must, wrong, message)
        must(raw.HasField("seq") and 0 <= raw.seq <= 255, "no sequence number")
        if kind == "NBIRTH":
            must(raw.seq == 0, f"NBIRTH has seq {raw.seq}")
            self.births, self.aliases = {}, {}
        else:
            must(self.seq is not None, f"{kind} before NBIRTH")
            must(self.seq is None or raw.seq == (self.seq + 1) % 256, f"seq {raw.seq} after {self.seq}")
        self.seq = raw.seq
        if kind.endswith("BIRTH"):
            self.birth(kind, device, raw, must)
            payload = KINDS[kind].decode(message.payload)
            self.births[device] = payload
        else:
            birth = self.births.get(device)
            must(birth is not None, f"{kind} of {device} that is not born")
            if birth is None:
                return None, wrong
            for metric in raw.metrics:
                must(metric.HasField("alias") and not metric.HasField("name"), "data by name")
                must(self.aliases.get(metric.alias, (None,))[0] == device, f"alias {metric.alias} is another's")
            payload = KINDS[kind].decode(message.payload, birth=birth)
            if kind == "DDEATH":
                del self.births[device]
        live = [metric.timestamp for metric in raw.metrics if not metric.is_historical]
        must(live == sorted(live), "not in the order of time")
        for metric in raw.metrics:
            must(metric.HasField("timestamp"), "a metric without a timestamp")
            must(metric.is_null == (metric.WhichOneof("value") is None), f"{metric.name}: null or not")
        return (raw, getattr(payload, "metrics", ())), wrong

    def birth(self, kind, device, raw, must):
        names = [metric.name for metric in raw.metrics]
        must(len({name.lower() for name in names}) == len(names), "two metrics of one name")
        for metric in raw.metrics:
            must(metric.HasField("datatype"), f"{metric.name} without a type")
            if metric.HasField("alias"):
                owner = self.aliases.setdefault(metric.alias, (device, metric.name))
                must(owner == (device, metric.name), f"alias {metric.alias} is that of {owner}")
        if kind == "NBIRTH":
            of_node = {metric.name: metric for metric in raw.metrics}
            must("bdSeq" in of_node and of_node["bdSeq"].datatype == spb.DataType.INT64, "no bdSeq")
            rebirth = of_node.get("Node Control/Rebirth")
            must(rebirth is not None and not rebirth.HasField("alias"), "no Rebirth, or with an alias")
            must(rebirth is not None and rebirth.boolean_value is False, "Rebirth is not false")
            self.bdseq = of_node["bdSeq"].long_value

    def death(self, raw, must, wrong, message):
        must(not raw.HasField("seq"), "NDEATH has a sequence number")
        must([metric.name for metric in raw.metrics] == ["bdSeq"], "NDEATH has other metrics")
        spb.NDeath.decode(message.payload)
        # A late one, of a session before, is told by its number.
        if raw.metrics[0].long_value == self.bdseq:
            self.seq, self.births = None, {}
        return (raw, ()), wrong


def quality(metric):
    for key, value in zip(metric.properties.keys, metric.properties.values):
        if key == "Quality":
            assert value.type == spb.DataType.INT32, value
            return value.int_value
    return None


def told(kind, device, raw, metrics, wrong):
    shown = {}
    for decoded, metric in zip(metrics, raw.metrics):
        shown.setdefault(decoded.name, []).append(
            [decoded.value, quality(metric), metric.is_historical, metric.timestamp])
    bdseq = [metric.long_value for metric in raw.metrics if metric.name == "bdSeq"]
    return {
        "kind": kind, "device": device, "seq": raw.seq if raw.HasField("seq") else None,
        "bdseq": bdseq[0] if bdseq else None, "metrics": shown, "wrong": wrong,
    }


def main():
    port, group, edge = int(sys.argv[1]), sys.argv[2], sys.argv[3]
    judge = Judge()
    client = mqtt.Client("sparkplug-judge")

    def on_message(_client, _userdata, message):
        levels = message.topic.split("/")
        if len(levels) < 4 or levels[1] != group or levels[3] != edge or levels[2] not in KINDS:
            return
        kind, device = levels[2], levels[4] if len(levels) > 4 else ""
        try:
            answer, wrong = judge.message(kind, device, message)
            line = told(kind, device, *answer, wrong) if answer else {"kind": kind, "device": device, "wrong": wrong}
        except Exception as error:
            line = {"kind": kind, "device": device, "wrong": [f"it cannot be decoded: {error!r}"]}
        print(json.dumps(line), flush=True)

    def on_connect(client, *_):
        client.subscribe("spBv1.0/#", 1)

    client.on_message = on_message
    client.on_connect = on_connect
    client.on_subscribe = lambda *_: print("ready", flush=True)
    client.connect("127.0.0.1", port)
    client.loop_start()
    for line in sys.stdin:
        words = line.split()
        now = int(time.time() * 1000)
        metric = lambda name: spb.Metric(timestamp=now, name=name, datatype=spb.DataType.BOOLEAN, value=True)
        if words[0] == "rebirth":
            command = spb.NCmd(timestamp=now, metrics=(metric("Node Control/Rebirth"),))
            client.publish(f"spBv1.0/{group}/NCMD/{edge}", command.encode(include_dtypes=True))
        elif words[0] == "dcmd":
            written = metric(words[2])
            if len(words) > 3:
                written = spb.Metric(timestamp=now, name=words[2], datatype=spb.DataType.DOUBLE, value=float(words[3]))
            raw = protobuf.Payload.FromString(spb.DCmd(timestamp=now, metrics=(written,)).encode(include_dtypes=True))
            alias = [alias for alias, owner in judge.aliases.items() if owner == (words[1], words[2])]
            if alias:
                raw.metrics[0].alias = alias[0]
                raw.metrics[0].ClearField("name")
            client.publish(f"spBv1.0/{group}/DCMD/{edge}/{words[1]}", raw.SerializeToString())
        elif words[0] == "state":
            state = {"online": words[2] == "online", "timestamp": now}
            client.publish(f"spBv1.0/STATE/{words[1]}", json.dumps(state), qos=1, retain=True)


main()
