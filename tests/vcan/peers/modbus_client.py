"""A Modbus TCP client (pymodbus) that takes one JSON request a line and answers one JSON line.

    {"port": 5020, "unit": 1, "read": "input_register", "address": 100, "count": 20}  ->  {"result": [...]}
    {"port": 5020, "unit": 1, "identify": true}                                      ->  {"result": {"0": "...", ...}}
    anything that fails                                                              ->  {"error": "..."}

A connection stays open until it fails, as a PLC's does.
"""

import json
import sys

from pymodbus import ModbusException
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ConnectionException

clients = {}


def connected(port):
    client = clients.get(port)
    if client is None or not client.connected:
        client = ModbusTcpClient("127.0.0.1", port=port, timeout=5, retries=0)
        if not client.connect():
            raise ConnectionError(f"no connection to port {port}")
        clients[port] = client
    return client


def read(client, request):
    functions = {
        "coil": client.read_coils,
        "discrete_input": client.read_discrete_inputs,
        "holding_register": client.read_holding_registers,
        "input_register": client.read_input_registers,
    }
    kind, count = request["read"], request["count"]
    answer = functions[kind](request["address"], count=count, device_id=request["unit"])
    if answer.isError():
        raise ValueError(str(answer))
    if kind in ("coil", "discrete_input"):
        return [int(bit) for bit in answer.bits[:count]]
    return answer.registers


def identify(client, request):
    objects = {}
    # 1 basic, 2 regular, 3 extended; a category is asked for until nothing more follows.
    for category in (1, 2, 3):
        start = 0
        while True:
            answer = client.read_device_information(read_code=category, object_id=start, device_id=request["unit"])
            if answer.isError():
                raise ValueError(str(answer))
            objects.update({str(key): value.decode() for key, value in answer.information.items()})
            if not answer.more_follows:
                break
            start = answer.next_object_id
    return objects


def answer(request):
    reused = getattr(clients.get(request["port"]), "connected", False)
    client = connected(request["port"])
    try:
        return identify(client, request) if request.get("identify") else read(client, request)
    except ConnectionException:
        # The server may have been restarted since the last request.
        clients.pop(request["port"]).close()
        if not reused:
            raise
        return answer(request)


for line in sys.stdin:
    try:
        print(json.dumps({"result": answer(json.loads(line))}), flush=True)
    except (ModbusException, ConnectionError, ValueError, OSError) as error:
        print(json.dumps({"error": f"{type(error).__name__}: {error}"}), flush=True)
