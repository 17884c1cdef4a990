"""A device description as a PhoXi's is, behind GenApi's own reference implementation.

The node map is the real one; only the registers below it are a dictionary. So what the driver
writes goes through GenApi's checks of names, access and values, as with a device.
"""

from __future__ import annotations

import struct

HEADER = """<?xml version="1.0" encoding="utf-8"?>
<RegisterDescription ModelName="Phoxi" VendorName="Test" ToolTip="" StandardNameSpace="None"
 SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1"
 MinorVersion="0" SubMinorVersion="0" ProductGuid="1" VersionGuid="1"
 xmlns="http://www.genicam.org/GenApi/Version_1_1"
 xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"
 xsi:schemaLocation="http://www.genicam.org/GenApi/Version_1_1 GenApiSchema.xsd">
<Category Name="Root" NameSpace="Standard">{features}</Category>
"""


class Description:
    """Builds the XML, feature by feature, each with a register of its own."""

    def __init__(self):
        self.features, self.nodes, self.registers = [], [], {}

    def _register(self, kind, name, access, content, address=None):
        address = 16 * (len(self.registers) + 1) if address is None else address
        self.registers[name] = (address, content)
        length = len(content)
        sign = "<Sign>Unsigned</Sign>" if kind == "IntReg" else ""
        self.nodes.append(
            f'<{kind} Name="{name}Reg"><Address>{address}</Address><Length>{length}</Length>'
            f"<AccessMode>{access}</AccessMode><pPort>Device</pPort>{sign}"
            f"<Endianess>LittleEndian</Endianess></{kind}>"
        )

    def _feature(self, name, xml):
        self.features.append(name)
        self.nodes.append(xml)

    def enumeration(self, name, values, at=0, access="RW"):
        self._register("IntReg", name, access, struct.pack("<I", at))
        entries = "".join(
            f'<EnumEntry Name="{value}"><Value>{i}</Value></EnumEntry>'
            for i, value in enumerate(values)
        )
        self._feature(
            name, f'<Enumeration Name="{name}">{entries}<pValue>{name}Reg</pValue></Enumeration>'
        )

    def boolean(self, name, at=False, access="RW"):
        self._register("IntReg", name, access, struct.pack("<I", at))
        self._feature(
            name,
            f'<Boolean Name="{name}"><pValue>{name}Reg</pValue><OnValue>1</OnValue>'
            "<OffValue>0</OffValue></Boolean>",
        )

    def integer(self, name, at):
        self._register("IntReg", name, "RO", struct.pack("<I", at))
        self._feature(name, f'<Integer Name="{name}"><pValue>{name}Reg</pValue></Integer>')

    def number(self, name, at):
        self._register("FloatReg", name, "RO", struct.pack("<f", at))
        self._feature(name, f'<Float Name="{name}"><pValue>{name}Reg</pValue></Float>')

    def command(self, name):
        self._register("IntReg", name, "RW", struct.pack("<I", 0))
        self._feature(
            name,
            f'<Command Name="{name}"><pValue>{name}Reg</pValue>'
            "<CommandValue>1</CommandValue></Command>",
        )

    def xml(self):
        features = "".join(f"<pFeature>{name}</pFeature>" for name in self.features)
        head = HEADER.format(features=features)
        return f'{head}{"".join(self.nodes)}<Port Name="Device"/></RegisterDescription>'


def node_map(description):
    """Return a GenApi node map over the description's registers, and the memory below it."""
    from genicam import genapi

    memory = {address: content for address, content in description.registers.values()}

    class Port(genapi.AbstractPort):  # type: ignore[misc]  # genicam has no types
        def read(self, address, length):
            return memory[address][:length]

        def write(self, address, value):
            memory[address] = bytes(value)

        def get_access_mode(self):
            return genapi.EAccessMode.RW

        def is_open(self):
            return True

    nodes, port = genapi.NodeMap(), Port()
    nodes.load_xml_from_string(description.xml())
    nodes.connect(port, "Device")
    return nodes, memory, port
