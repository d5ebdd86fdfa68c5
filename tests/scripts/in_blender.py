"""Runs inside Blender (bpy) for test_blender_extension.py: installs the extension as a user does and tries everything.

usage: in_blender.py EXTENSION.zip FILE.blend SELFCORRECT BLENDER FOLDER; prints one JSON object as its last line.
"""

import gc
import json
import sys
import threading
import time
import types
from pathlib import Path

import bpy

ARCHIVE, BLEND, COMMAND, PROGRAM, FOLDER = sys.argv[1:]
MODULE = "bl_ext.user_default.selfcorrect"


class Recorder:
    """Stands for a layout, which Blender hands out only while it draws a window; keeps all text."""

    def __init__(self):
        self.texts = []

    def __getattr__(self, name):
        def called(*arguments, **named):
            self.texts += [str(value) for value in (*arguments[-1:], named.get("text", "")) if value]
            return self

        return called


def traces():
    """All that an add-on can leave behind."""
    handlers = [getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)]
    return {
        "types": sorted(name for name in dir(bpy.types) if "selfcorrect" in name.lower()),
        "operators": [name for name in dir(bpy.ops) if name == "selfcorrect" and dir(getattr(bpy.ops, name))],
        "scene": hasattr(bpy.types.Scene, "selfcorrect"),
        "handlers": sum(len(each) for each in handlers if isinstance(each, list)),
        "threads": threading.active_count(),
        "addons": [addon.module for addon in bpy.context.preferences.addons if "selfcorrect" in addon.module],
    }


def settings():
    """Every setting of the render, and whether the file was touched."""
    scene = bpy.context.scene
    layer = scene.view_layers[0]
    parts = [scene.render, scene.render.image_settings, scene.cycles, layer, layer.cycles]
    values = [
        [
            f"{p.identifier}={getattr(part, p.identifier)}"
            for p in part.bl_rna.properties
            if p.type not in {"POINTER", "COLLECTION"}
        ]
        for part in parts
    ]
    return [*values, scene.frame_current, bpy.data.filepath]


def attempt(**named):
    """What calling the operator brings: its result, or the error that the user reads."""
    try:
        return sorted(bpy.ops.selfcorrect.render(**named))
    except RuntimeError as error:
        return str(error)


def drawn():
    extension = sys.modules[MODULE]
    recorder = Recorder()
    extension.SELFCORRECT_PT_panel.draw(type("Panel", (), {"layout": recorder})(), bpy.context)
    return recorder.texts


class Operator:
    """Stands for the operator, which only the event loop of a window makes; its methods are the real ones."""

    def __init__(self):
        real = vars(sys.modules[MODULE].SELFCORRECT_OT_render)
        for name in ("invoke", "modal", "_begin", "_end", "_failed", "_clean", "_status"):
            setattr(self, name, types.MethodType(real[name], self))
        self.animation, self.reports, self.timers = False, [], 0
        self.status, self.kinds = [], []

    def report(self, kind, message):
        self.reports.append(message)
        self.kinds += kind

    def status_text_set(self, text):
        self.status.append(text)

    def event_timer_add(self, interval, window):
        self.timers += 1
        return "timer"

    def event_timer_remove(self, timer):
        self.timers -= timer == "timer"


def in_the_event_loop(cancel=""):
    """Start as the button does, then one timer event after the other; what all came to.

    ``cancel`` is "button" or "escape".
    """
    operator = Operator()
    manager = types.SimpleNamespace(
        event_timer_add=operator.event_timer_add,
        event_timer_remove=operator.event_timer_remove,
        modal_handler_add=lambda operator: None,
        windows=[],
    )
    context = types.SimpleNamespace(
        scene=bpy.context.scene,
        preferences=bpy.context.preferences,
        window=None,
        window_manager=manager,
        workspace=types.SimpleNamespace(status_text_set=operator.status_text_set),
    )
    tick, mouse = types.SimpleNamespace(type="TIMER"), types.SimpleNamespace(type="MOUSEMOVE")
    answers = [operator.invoke(context, None), operator.modal(context, mouse)]
    seen = [drawn()]
    while (answer := operator.modal(context, tick)) == {"PASS_THROUGH"}:
        if cancel and sys.modules[MODULE].State.job.label:
            if cancel == "button":
                bpy.ops.selfcorrect.cancel()
            else:
                answers.append(operator.modal(context, types.SimpleNamespace(type="ESC", value="PRESS")))
        time.sleep(0.1)
    answers.append(answer)
    return {
        "answers": [*map(sorted, answers)],
        "reports": operator.reports,
        "timers": operator.timers,
        "drawn": seen[0],
        "status": operator.status,
        "kinds": operator.kinds,
    }


def cancelled():
    """A render that is stopped in the middle: what it says, and whether its process is gone."""
    extension, scene = sys.modules[MODULE], bpy.context.scene
    scene.selfcorrect.samples = 100000
    job = extension.work.plan(scene, COMMAND, range(1, 2), Path(FOLDER))
    while job.poll() and job.progress == 0:
        time.sleep(0.05)
    job.cancel()
    scene.selfcorrect.samples = 4
    return {"error": job.error, "progress": job.progress, "returncode": job._process.returncode, "polls": job.poll()}


def main():
    bpy.ops.wm.open_mainfile(filepath=BLEND)
    found = {"before": traces()}
    installed = {"filepath": ARCHIVE, "repo": "user_default", "enable_on_install": True}
    bpy.ops.extensions.package_install_files(**installed)
    found["enabled"] = traces()
    scene = bpy.context.scene
    preferences = bpy.context.preferences.addons[MODULE].preferences
    scene.selfcorrect.samples, scene.selfcorrect.output = 4, FOLDER
    found["settings before"] = settings()
    preferences.command = "/nowhere/selfcorrect"
    found["missing"], found["missing panel"] = attempt(), drawn()
    preferences.command = COMMAND
    found["panel"] = drawn()
    found["frame"], found["settings after"] = attempt(), settings()
    image = bpy.data.images["selfcorrect"]
    len(image.pixels)  # loads it
    found["image"] = {"path": image.filepath, "type": image.type}
    found["images"] = len(bpy.data.images)
    found["again"], found["images again"] = in_the_event_loop(), len(bpy.data.images)
    found["cancelled again"] = in_the_event_loop("button")
    found["escaped"] = in_the_event_loop("escape")
    scene.selfcorrect.denoiser, scene.selfcorrect.other = "other", "nonsense"
    found["other panel"], found["failing in a window"] = drawn(), in_the_event_loop()
    found["failing"], found["settings after failing"] = attempt(), settings()
    scene.selfcorrect.denoiser, scene.selfcorrect.prefilter = "oidn", "oidn:fast"
    scene.selfcorrect.preset, scene.selfcorrect.aovs, scene.selfcorrect.page = "fast", True, True
    found["oidn panel"] = drawn()
    found["planned"] = sys.modules[MODULE].work.plan(scene, COMMAND, range(1, 3), Path(FOLDER)).steps[1].command
    scene.selfcorrect.denoiser, scene.selfcorrect.aovs = "best", False
    found["cancelled"] = cancelled()
    scene.frame_start, scene.frame_end, scene.frame_step = 1, 3, 2
    bpy.app.binary_path = PROGRAM  # from here on as in Blender itself, which renders with another of its kind
    found["animation"], found["source"] = attempt(animation=True), image.source
    found["page panel"] = drawn()
    scene.render.engine = "BLENDER_WORKBENCH"
    found["engine"] = attempt()
    bpy.ops.preferences.addon_disable(module=MODULE)
    gc.collect()
    found["disabled"] = traces()
    print(json.dumps(found))


main()
