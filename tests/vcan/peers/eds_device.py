"""A device that python-canopen makes of an EDS, and that EDS by python-canopen's own export.

    eds_device.py INTERFACE NODE FILE.eds

Writes FILE.eds, becomes the device that it describes, says `ready`. A line `INDEX SUB VALUE` (hexadecimal index and sub-index)
gives an input another value.
"""

import sys
import threading
import time

import canopen
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, ObjectDictionary, datatypes

U8, U16, U32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32


def describe():
    od = ObjectDictionary()
    information = od.device_information
    information.vendor_name, information.vendor_number = "Example Instruments", 0x7F4
    information.product_name, information.product_number = "Tank Monitor", 0x31
    information.revision_number = 2
    information.simple_boot_up_slave = True
    information.nr_of_TXPDO = 1

    def variable(index, sub, name, data_type, default, access="ro", mappable=False, parent=None, unit=""):
        entry = ODVariable(name, index, sub)
        entry.data_type, entry.default, entry.access_type = data_type, default, access
        entry.pdo_mappable, entry.unit = mappable, unit
        (od.add_object if parent is None else parent.add_member)(entry)

    def group(kind, index, name, entries):
        parent = kind(name, index)
        od.add_object(parent)
        variable(index, 0, "Number of entries", U8, len(entries), "rw" if index == 0x1A00 else "ro", False, parent)
        for sub, entry in enumerate(entries, 1):
            variable(index, sub, *entry[:3], entry[3] if len(entry) > 3 else "ro", *entry[4:5], parent=parent)

    variable(0x1000, 0, "Device type", U32, 0x00030191)
    variable(0x1001, 0, "Error register", U8, 0)
    variable(0x1017, 0, "Producer heartbeat time", U16, 0, "rw")
    group(ODRecord, 0x1018, "Identity object", [
        ("Vendor id", U32, 0x7F4), ("Product code", U32, 0x31), ("Revision", U32, 2), ("Serial number", U32, 4711)])
    group(ODRecord, 0x1800, "TPDO1 parameter", [
        ("COB-ID", U32, 0x180 + int(sys.argv[2]), "rw"), ("Transmission type", U8, 255, "rw"),
        ("Inhibit time", U16, 0, "rw"), ("Reserved", U8, 0, "rw"), ("Event timer", U16, 200, "rw")])
    group(ODRecord, 0x1A00, "TPDO1 mapping", [
        ("First", U32, 0x60000108, "rw"), ("Second", U32, 0x64010110, "rw"), ("Third", U32, 0x64010210, "rw")])
    group(ODArray, 0x6000, "Digital input", [("Pumps", U8, 0, "ro", True)])
    group(ODArray, 0x6401, "Analogue input", [
        ("Level", datatypes.INTEGER16, 0, "ro", True), ("Inflow", datatypes.INTEGER16, 0, "ro", True)])
    variable(0x2100, 0, "Operating hours", U32, 123456, "ro", True, unit="h")
    variable(0x2101, 0, "Oil temperature", datatypes.REAL32, 61.25, "ro", True)
    return od


interface, node_id, file = sys.argv[1], int(sys.argv[2]), sys.argv[3]
canopen.export_od(describe(), file)

network = canopen.Network()
network.connect(interface="socketcan", channel=interface)
node = canopen.LocalNode(node_id, file)
network.add_node(node)
node.tpdo.read()
for index, sub in ((0x6000, 1), (0x6401, 1), (0x6401, 2)):
    node.tpdo[1][node.object_dictionary[index][sub].qualname].raw = 0
node.nmt.state = "INITIALISING"
node.nmt.state = "PRE-OPERATIONAL"
print("ready", flush=True)


def send():
    while True:
        if node.nmt.state == "OPERATIONAL":
            node.tpdo[1].transmit()
        time.sleep(0.2)


threading.Thread(target=send, daemon=True).start()
for line in sys.stdin:
    index, sub, value = line.split()
    entry = node.object_dictionary[int(index, 16)][int(sub, 16)]
    node.tpdo[1][entry.qualname].raw = int(value)
