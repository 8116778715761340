"""An SDO client of python-canopen; at its end it says what it found as one line of JSON.

    sdo_client.py INTERFACE NODE judge COUNT SEED     writes and reads 0x2F00:1 with random bytes, by every kind of transfer
    sdo_client.py INTERFACE NODE visit SECONDS        reads and writes a DST P92C while others do so as well
"""

import collections
import json
import random
import sys
import time

import canopen

network = canopen.Network()
network.connect(interface="socketcan", channel=sys.argv[1])
node = network.add_node(canopen.RemoteNode(int(sys.argv[2]), canopen.ObjectDictionary()))
# A guest system may stall.
node.sdo.RESPONSE_TIMEOUT = 5.0


def write(index, sub, data, block):
    if block:
        with node.sdo.open(index, sub, "wb", buffering=7, size=len(data), block_transfer=True) as stream:
            stream.write(data)
    else:
        node.sdo.download(index, sub, data)


def read(index, sub, block):
    if block:
        with node.sdo.open(index, sub, "rb", block_transfer=True) as stream:
            return stream.read()
    return node.sdo.upload(index, sub)


def judge(count, seed):
    chance = random.Random(seed)
    found = collections.Counter(transfers=0, bytes=0, mismatches=0)
    wrong = []
    for number in range(count):
        size = chance.choice([chance.randint(1, 4), chance.randint(5, 100), chance.randint(101, 2000)])
        data = chance.randbytes(size)
        write_block, read_block = (size > 4 and chance.random() < 0.5 for _ in range(2))
        try:
            write(0x2F00, 1, data, write_block)
            back = read(0x2F00, 1, read_block)
        except (canopen.SdoAbortedError, canopen.SdoCommunicationError) as error:
            back = repr(error)
        for block in (write_block, read_block):
            found["block" if block else "expedited" if size <= 4 else "segmented"] += 1
        found["transfers"] += 2
        found["bytes"] += 2 * size
        if back != data:
            found["mismatches"] += 1
            wrong.append(f"{number}: {size} bytes, block {write_block} {read_block}: {str(back)[:200]}")
    return {**found, "wrong": wrong[:5]}


def visit(seconds):
    found = collections.Counter(right=0, wrong=0, errors=0)
    names = collections.Counter()
    expected = {
        (0x1000, 0): (0x00020194).to_bytes(4, "little"),
        (0x1018, 1): (0x23D).to_bytes(4, "little"),
        (0x1008, 0): b"DST P92C CANopen",
    }
    node.sdo.RESPONSE_TIMEOUT = 1.0
    end = time.monotonic() + seconds
    number = 0
    while time.monotonic() < end:
        number += 1
        filter_constant = bytes([number % 200])
        # As people and PLCs ask: with time in between. Otherwise hardly an answer finds the right client.
        time.sleep(0.05)
        for (index, sub), value in [*expected.items(), ((0x61A1, 1), filter_constant)]:
            try:
                if index == 0x61A1:
                    node.sdo.download(index, sub, value)
                back = node.sdo.upload(index, sub)
            except (canopen.SdoAbortedError, canopen.SdoCommunicationError) as error:
                found["errors"] += 1
                names[str(error)] += 1
                continue
            found["right" if back == value else "wrong"] += 1
            if back != value:
                names[f"{index:04X}:{sub} = {back!r}"] += 1
    return {**found, "names": names}


arguments = [int(word) for word in sys.argv[4:]]
print(json.dumps({"judge": judge, "visit": visit}[sys.argv[3]](*arguments)), flush=True)
