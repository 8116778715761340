"""Reads an input register by Modbus/TCP Security with pymodbus, once: the register, or what went wrong.

    modbus_tls_client.py PORT CA CERTIFICATE KEY UNIT ADDRESS

CERTIFICATE and KEY may be `-`: then none is shown.
"""

import ssl
import sys

from pymodbus.client import ModbusTlsClient

port, authority, certificate, key, unit, address = sys.argv[1:]
context = ssl.create_default_context(cafile=authority)
# pymodbus gives the name of the host to nobody; the chain is checked all the same.
context.check_hostname = False
if certificate != "-":
    context.load_cert_chain(certificate, key)
client = ModbusTlsClient("127.0.0.1", port=int(port), sslctx=context, retries=0)
if not client.connect():
    sys.exit("no connection")
try:
    answer = client.read_input_registers(int(address), count=1, device_id=int(unit))
except Exception as error:
    sys.exit(f"{type(error).__name__}: {error}")
if answer.isError():
    sys.exit(str(answer))
print(answer.registers[0])
