"""A CANopen device of python-canopen: node 5 on the SocketCAN interface that is named; says `ready` when it is there."""
import canopen, sys, time
from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable
from canopen.objectdictionary import datatypes
od = ObjectDictionary()
def variable(index, name, data_type, default, parent=None, sub=0):
    v = ODVariable(name, index, sub)
    v.data_type, v.default, v.access_type = data_type, default, "rw"
    if parent is None:
        od.add_object(v)
    else:
        parent.add_member(v)
variable(0x1000, "Device type", datatypes.UNSIGNED32, 0x00020194)
variable(0x1008, "Name", datatypes.VISIBLE_STRING, "P92C and friends")
variable(0x1017, "Producer heartbeat time", datatypes.UNSIGNED16, 0)
identity = ODRecord("Identity", 0x1018)
od.add_object(identity)
for sub, value in enumerate([4, 0x23D, 1, 2, 3]):
    variable(0x1018, f"Identity {sub}", datatypes.UNSIGNED8 if sub == 0 else datatypes.UNSIGNED32, value, identity, sub)
network = canopen.Network()
network.connect(interface="socketcan", channel=sys.argv[1])
network.create_node(5, od)
print("ready", flush=True)
while True:
    time.sleep(1)
