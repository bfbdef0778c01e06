"""Find a second node that publishes a state or command for which a cell has one node."""

from __future__ import annotations

from rclpy.node import Node

from tapping_cell.logic.host import ONE_SERVER


def contest(node: Node, name: str) -> str:
    """Return a sentence that names the nodes if several nodes publish this topic or offer this
    service; otherwise an empty string."""
    if name in ONE_SERVER:
        number = node.count_services(name)
        providers = _servers(node, name) if number > 1 else []
        does = "offer"
    else:
        number = node.count_publishers(name)
        infos = node.get_publishers_info_by_topic(name) if number > 1 else []
        providers = [_full_name(info.node_name, info.node_namespace) for info in infos]
        does = "publish"
    if number < 2:
        return ""
    return (
        f"{number} nodes {does} {name} ({', '.join(sorted(providers))}), but a cell has one; end"
        " the others, or give each cell a namespace or a ROS domain of its own"
    )


def _servers(node: Node, service: str) -> list[str]:
    wanted = node.resolve_service_name(service)
    return [
        _full_name(name, namespace)
        for name, namespace in node.get_node_names_and_namespaces()
        if any(
            offered == wanted
            for offered, _ in node.get_service_names_and_types_by_node(name, namespace)
        )
    ]


def _full_name(name: str, namespace: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"
