"""Let SAPIEN and stock ManiSkill run on a machine without a Vulkan device, by making everything visual inert."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any


class _Inert:
    """Stands in for a render material or texture: takes any arguments and attributes, does nothing."""

    def __init__(self, *_args: Any, **_kwargs: Any) -> None:
        pass


@cache
def enable() -> None:
    """Replace SAPIEN's render materials by inert ones and drop all visual shapes, once for this process.

    SAPIEN 3.0.3 raises "failed to find a rendering device" when a material is made without Vulkan, even where nothing
    is rendered. Physics is untouched. Call it before a stock environment is made.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Failed to find system libvulkan")
        import sapien  # noqa: PLC0415  the simulator is an optional extra
        import sapien.wrapper.actor_builder  # noqa: PLC0415
        import sapien.wrapper.urdf_loader  # noqa: PLC0415

    def add_nothing(self: Any, *_args: Any, **_kwargs: Any) -> Any:
        return self

    for module in (sapien.render, sapien.wrapper.urdf_loader):
        module.RenderMaterial = _Inert
        module.RenderTexture2D = _Inert
    builder = sapien.wrapper.actor_builder.ActorBuilder
    for name in vars(builder):
        if name.startswith("add_") and name.endswith(("_visual", "_visual_from_file")):
            setattr(builder, name, add_nothing)
