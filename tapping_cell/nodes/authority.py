"""Find a second node that publishes a state or command for which a cell has one node."""

from __future__ import annotations

from rclpy.node import Node, NodeNameNonExistentError

from tapping_cell.logic.host import ONE_SERVER

REMEDY = "end the others, or give each cell a namespace or a ROS domain of its own"


def contest(node: Node, name: str) -> str:
    """Return a sentence that names the nodes if several nodes publish this topic or offer this
    service; otherwise an empty string."""
    if name in ONE_SERVER:
        number, does = node.count_services(name), "offer"
        nodes = node.get_node_names_and_namespaces() if number > 1 else []
        providers = [_full(*each) for each in nodes if _offers(node, *each, name)]
    else:
        number, does = node.count_publishers(name), "publish"
        providers = _publishers(node, name) if number > 1 else []
    if number < 2:
        return ""
    names = ", ".join(sorted(providers))
    return f"{number} nodes {does} {name} ({names}), but a cell has one; {REMEDY}"


def impostor(node: Node, service: str) -> str:
    """Return a sentence if the only server of a service is not the node that publishes the topic
    that belongs to it (``ONE_SERVER``); otherwise an empty string."""
    topic = ONE_SERVER[service]
    infos = node.get_publishers_info_by_topic(topic)
    if any(_offers(node, info.node_name, info.node_namespace, service) for info in infos):
        return ""
    owners = ", ".join(_publishers(node, topic)) or "none"
    return f"{service} is not offered by the node that publishes {topic} ({owners}); {REMEDY}"


def _publishers(node: Node, topic: str) -> list[str]:
    infos = node.get_publishers_info_by_topic(topic)
    return [_full(info.node_name, info.node_namespace) for info in infos]


def _offers(node: Node, name: str, namespace: str, service: str) -> bool:
    try:
        offered = node.get_service_names_and_types_by_node(name, namespace)
    except NodeNameNonExistentError:  # it has ended, or its name is not known yet
        return False
    return node.resolve_service_name(service) in {found for found, _ in offered}


def _full(name: str, namespace: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"
