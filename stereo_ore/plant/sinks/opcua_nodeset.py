"""The OPC UA model as a NodeSet2 file: what the server serves, and what engineering tools import.

Source: OPC 10000-6, Annex F (UANodeSet.xsd). Units are written as ``EUInformation`` under its XML
encoding, i=888: clients read a value under its data type, i=887, as null.
"""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from stereo_ore.plant.sinks.opcua_model import MODEL, NAMESPACE, UNITS, WRITTEN_FOLDERS, Variable

NODESET = "http://opcfoundation.org/UA/2011/03/UANodeSet.xsd"
_TYPES = "http://opcfoundation.org/UA/2008/02/Types.xsd"
UNECE = "http://www.opcfoundation.org/UA/units/un/cefact"

ALIASES = {
    "Boolean": "i=1",
    "Int16": "i=4",
    "UInt16": "i=5",
    "Int32": "i=6",
    "UInt32": "i=7",
    "Int64": "i=8",
    "Double": "i=11",
    "String": "i=12",
    "DateTime": "i=13",
    "EUInformation": "i=887",
    "Organizes": "i=35",
    "HasModellingRule": "i=37",
    "HasTypeDefinition": "i=40",
    "HasSubtype": "i=45",
    "HasProperty": "i=46",
    "HasComponent": "i=47",
}
OBJECTS, _FOLDER, OBJECT, VARIABLE, PROPERTY, ANALOG = (
    "i=85",
    "i=61",
    "i=58",
    "i=63",
    "i=68",
    "i=17497",
)
EU_ENCODING = "i=888"
_MANDATORY = "i=78"
ROOT, TYPE = "StereoOre", "StereoOreType"
"""The object, and the type that it is of: what controllers' tools make blocks from."""
READ, READ_WRITE = "1", "3"


def nodeset() -> str:
    """UANodeSet XML of the model, the same at every call; namespace 1 of the file is
    `NAMESPACE`.
    """
    root = Element("UANodeSet", {"xmlns": NODESET})
    SubElement(SubElement(root, "NamespaceUris"), "Uri").text = NAMESPACE
    model = SubElement(SubElement(root, "Models"), "Model", ModelUri=NAMESPACE, Version="2.2.0")
    model.set("PublicationDate", "2026-11-30T00:00:00Z")
    base = {
        "ModelUri": "http://opcfoundation.org/UA/",
        "Version": "1.04",
        "PublicationDate": "2018-05-15T00:00:00Z",
    }
    SubElement(model, "RequiredModel", base)
    aliases = SubElement(root, "Aliases")
    for name, identifier in ALIASES.items():
        SubElement(aliases, "Alias", Alias=name).text = identifier
    _node(root, "UAObjectType", TYPE, TYPE, None, (OBJECT, "HasSubtype"), "Targets for an arm")
    _components(root, TYPE)
    _node(root, "UAObject", ROOT, ROOT, f"ns=1;s={TYPE}", (OBJECTS, "Organizes"))
    _components(root, ROOT)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _components(root: Element, owner: str) -> None:
    """Folders and variables of the type or of the object; those of the type are mandatory."""
    known = len(root)
    for folder in dict.fromkeys(variable.folder for variable in MODEL):
        parent = f"ns=1;s={owner}", "HasComponent"
        _node(root, "UAObject", f"{owner}.{folder}", folder, _FOLDER, parent)
    for variable in MODEL:
        _variable(root, owner, variable)
    if owner == TYPE:
        for node in root[known:]:
            references = node.find("References")
            assert references is not None, "every node has a parent"
            rule = SubElement(references, "Reference", ReferenceType="HasModellingRule")
            rule.text = _MANDATORY


def _node(
    root: Element,
    kind: str,
    id: str,
    name: str,
    type: str | None,
    parent: tuple[str, str],
    text: str = "",
    space: int = 1,
) -> Element:
    """A node with its type, which a type has not, and its parent, given as node id and type of
    reference.
    """
    browse_name = f"{space}:{name}" if space else name
    node = SubElement(root, kind, NodeId=f"ns=1;s={id}", BrowseName=browse_name)
    owner, reference = parent
    if reference not in ("Organizes", "HasSubtype"):
        node.set("ParentNodeId", owner)
    SubElement(node, "DisplayName").text = name
    if text:
        SubElement(node, "Description").text = text
    references = SubElement(node, "References")
    if type is not None:
        SubElement(references, "Reference", ReferenceType="HasTypeDefinition").text = type
    SubElement(references, "Reference", ReferenceType=reference, IsForward="false").text = owner
    return node


def _variable(root: Element, owner: str, variable: Variable) -> None:
    id = f"{owner}.{variable.folder}.{variable.name}"
    parent = f"ns=1;s={owner}.{variable.folder}", "HasComponent"
    node = _node(
        root,
        "UAVariable",
        id,
        variable.name,
        ANALOG if variable.unit else VARIABLE,
        parent,
        variable.text,
    )
    node.set("DataType", variable.type)
    node.set("ValueRank", "-1" if variable.length is None else "1")
    if variable.length is not None:
        node.set("ArrayDimensions", str(variable.length))
    access = READ_WRITE if variable.folder in WRITTEN_FOLDERS else READ
    node.set("AccessLevel", access)
    node.set("UserAccessLevel", access)
    if variable.frame:
        frame = _node(
            root, "UAVariable", f"{id}.Frame", "Frame", PROPERTY, (f"ns=1;s={id}", "HasProperty")
        )
        frame.set("DataType", "String")
        SubElement(SubElement(frame, "Value"), f"{{{_TYPES}}}String").text = variable.frame
    if variable.unit:
        _unit(root, id, variable.unit)


def _unit(root: Element, id: str, unit: str) -> None:
    """The property EngineeringUnits of OPC 10000-8, in namespace 0."""
    parent = f"ns=1;s={id}", "HasProperty"
    node = _node(root, "UAVariable", f"{id}.Unit", "EngineeringUnits", PROPERTY, parent, space=0)
    node.set("DataType", "EUInformation")
    wrapper = SubElement(SubElement(node, "Value"), f"{{{_TYPES}}}ExtensionObject")
    SubElement(
        SubElement(wrapper, f"{{{_TYPES}}}TypeId"), f"{{{_TYPES}}}Identifier"
    ).text = EU_ENCODING
    body = SubElement(SubElement(wrapper, f"{{{_TYPES}}}Body"), f"{{{_TYPES}}}EUInformation")
    SubElement(body, f"{{{_TYPES}}}NamespaceUri").text = UNECE
    SubElement(body, f"{{{_TYPES}}}UnitId").text = str(UNITS[unit].code)
    for tag, text in (("DisplayName", unit), ("Description", UNITS[unit].name)):
        SubElement(SubElement(body, f"{{{_TYPES}}}{tag}"), f"{{{_TYPES}}}Text").text = text
