"""An SDO server of python-canopen that says what it was given.

    sdo_server.py INTERFACE NODE

0x2F00:1 to 0x2F00:8 take and give bytes of any number. Says `ready`, then for each object that was written a line
`SUB LENGTH CRC32`.
"""

import sys
import time
import zlib

import canopen
from canopen.objectdictionary import ODRecord, ODVariable, ObjectDictionary, datatypes

od = ObjectDictionary()
store = ODRecord("Store", 0x2F00)
od.add_object(store)
for sub in range(1, 9):
    entry = ODVariable(f"Store {sub}", 0x2F00, sub)
    entry.data_type, entry.access_type = datatypes.DOMAIN, "rw"
    store.add_member(entry)

network = canopen.Network()
network.connect(interface="socketcan", channel=sys.argv[1])
node = canopen.LocalNode(int(sys.argv[2]), od)
network.add_node(node)
node.add_write_callback(
    lambda index, subindex, od, data: print(subindex, len(data), zlib.crc32(bytes(data)), flush=True))
print("ready", flush=True)
while True:
    time.sleep(1)
