"""A panel in Blender's render properties: renders two halves, corrects them with selfcorrect and shows the result."""

import shutil
import tempfile
import time
from pathlib import Path

import bpy

from . import work
from .job import CANCELLED, Job

INTERVAL = 0.2  # seconds between two looks at the programs


class State:
    """The job that runs, if any, and how the last one ended; Blender's own data cannot hold either."""

    job: Job | None = None
    message: str = ""
    page: str = ""  # the report of the last job


class SelfcorrectPreferences(bpy.types.AddonPreferences):
    """Where the command is."""

    bl_idname = __package__

    command: bpy.props.StringProperty(
        name="selfcorrect command",
        description="The installed selfcorrect program; empty takes the one on PATH",
        subtype="FILE_PATH",
    )

    def draw(self, context):
        self.layout.prop(self, "command")
        found = work.find_command(self)
        self.layout.label(
            text=found or f"Not found. In a terminal: {work.how_to_install()}", icon="CHECKMARK" if found else "ERROR"
        )


class SelfcorrectSettings(bpy.types.PropertyGroup):
    """What the panel shows, saved with the scene."""

    samples: bpy.props.IntProperty(
        name="Samples", min=0, description="Of both halves together; 0 takes the scene's render samples"
    )
    output: bpy.props.StringProperty(
        name="Folder", default="//selfcorrect", subtype="DIR_PATH", description="For the halves and the result"
    )
    denoiser: bpy.props.EnumProperty(
        name="Denoiser",
        items=[
            ("best", "Best Installed", "OpenImageDenoise where it is installed, else the network of selfcorrect"),
            ("oidn", "OpenImageDenoise", "Intel's, as in Blender"),
            ("onnx", "selfcorrect", "The network that selfcorrect brings"),
            ("nfor", "NFOR", "First-order regression on albedo and normal; slow, without a neural network"),
            ("joint-bilateral", "Joint Bilateral", "A simple filter, guided by albedo and normal"),
            ("other", "Other", "What is written below"),
        ],
    )
    prefilter: bpy.props.EnumProperty(
        name="Prefilter",
        description="What OpenImageDenoise does about noise in albedo and normal",
        items=[
            ("oidn", "Accurate", "Denoise albedo and normal first"),
            ("oidn:fast", "Fast", "Take them for free of noise, as they are"),
            ("oidn:none", "None", "Take them for noisy, as they are"),
        ],
    )
    other: bpy.props.StringProperty(
        name="Name", description="As after --denoiser: onnx:MODEL.onnx, command:..., file.py:Class"
    )
    preset: bpy.props.EnumProperty(
        name="Preset",
        items=[
            ("balanced", "Balanced", "The default"),
            ("fast", "Fast", "An eighth of the training"),
            ("best", "Best", "More training"),
            ("paper", "Paper", "The published method as it is, without the guard"),
        ],
    )
    aovs: bpy.props.BoolProperty(
        name="Light Passes", description="Correct light passes and light groups too, so that they sum to the picture"
    )
    page: bpy.props.BoolProperty(
        name="Report", description="Write a page to look at beside the result: a slider, maps, and what was gained"
    )


def preferences(context):
    return context.preferences.addons[__package__].preferences


class SELFCORRECT_OT_render(bpy.types.Operator):
    """Render two halves with another Blender, correct them, and load the result"""

    bl_idname = "selfcorrect.render"
    bl_label = "Render and Correct"

    animation: bpy.props.BoolProperty(name="Animation", description="All frames of the scene, not the current one only")

    @classmethod
    def poll(cls, context):
        return State.job is None and context.scene is not None

    def execute(self, context):
        """Wait for the result: what scripts and Blender in the background call."""
        try:
            self._begin(context)
            while State.job.poll():
                time.sleep(INTERVAL)
            return self._end(context)
        except work.WorkError as error:
            return self._failed(str(error))
        finally:
            self._clean()

    def invoke(self, context, event):
        """Start, and leave Blender to the user meanwhile."""
        try:
            self._begin(context)
        except work.WorkError as error:
            self._clean()
            return self._failed(str(error))
        self._status(context)
        self._timer = context.window_manager.event_timer_add(INTERVAL, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "ESC" and event.value == "PRESS" and State.job is not None:
            State.job.cancel()
            return {"RUNNING_MODAL"}  # nobody else is to be cancelled by this key
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        running = State.job is not None and State.job.poll()
        self._status(context)
        if running:
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)
        try:
            return self._end(context)
        except work.WorkError as error:
            return self._failed(str(error))
        finally:
            self._clean()

    def _status(self, context):
        """Progress in the status bar and in the panel."""
        if State.job is not None:
            context.workspace.status_text_set(f"selfcorrect: {State.job.progress:.0%} {State.job.label}   Esc: cancel")
        for window in context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "PROPERTIES":
                    area.tag_redraw()

    def cancel(self, context):
        """Blender itself ends the operator, for another file or to quit."""
        if context.workspace is not None:  # there is none left where Blender quits
            context.workspace.status_text_set(None)
        self._clean()

    def _begin(self, context):
        scene = context.scene
        shot = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        frames = shot if self.animation else range(scene.frame_current, scene.frame_current + 1)
        State.message = State.page = ""
        self._scratch = Path(tempfile.mkdtemp(prefix="selfcorrect-"))
        State.job = work.plan(scene, work.find_command(preferences(context)), frames, self._scratch)

    def _end(self, context):
        job = State.job
        if job is None or job.error is not None:
            return self._failed(CANCELLED if job is None else job.error)
        work.show(job.outputs, [window.screen for window in context.window_manager.windows])
        State.page = str(job.page) if job.page is not None and job.page.is_file() else ""
        State.message = f"{job.outputs[0].name} in {job.outputs[0].parent}"
        self.report({"INFO"}, State.message)
        return {"FINISHED"}

    def _failed(self, message):
        State.message = message
        # Blender shows an error as a pop-up; who has cancelled knows
        self.report({"INFO"} if message == CANCELLED else {"ERROR"}, message)
        return {"CANCELLED"}

    def _clean(self):
        if State.job is not None:
            State.job.cancel()  # nothing where it has ended
        State.job = None
        shutil.rmtree(self._scratch, ignore_errors=True)


class SELFCORRECT_OT_cancel(bpy.types.Operator):
    """Stop rendering or correcting"""

    bl_idname = "selfcorrect.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context):
        return State.job is not None

    def execute(self, context):
        State.job.cancel()
        return {"FINISHED"}


class SELFCORRECT_PT_panel(bpy.types.Panel):
    """The panel in the render properties."""

    bl_idname = "SELFCORRECT_PT_panel"
    bl_label = "selfcorrect"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        return context.scene.render.engine == "CYCLES"

    def draw(self, context):
        layout, settings = self.layout, context.scene.selfcorrect
        layout.use_property_split = True
        if State.job is not None:
            layout.progress(factor=State.job.progress, text=State.job.label)
            layout.operator("selfcorrect.cancel", icon="CANCEL")
            return
        if work.find_command(preferences(context)) is None:
            box = layout.box()
            box.label(text="selfcorrect is not installed", icon="ERROR")
            box.label(text=f"In a terminal: {work.how_to_install()}")
            box.label(text="Or name the program in the preferences:")
            box.operator("preferences.addon_show", text="Preferences", icon="PREFERENCES").module = __package__
            return
        beside = {"oidn": ["prefilter"], "other": ["other"]}.get(settings.denoiser, [])
        for name in ("samples", "output", "denoiser", *beside, "preset", "aovs", "page"):
            layout.prop(settings, name)
        row = layout.row(align=True)
        row.operator("selfcorrect.render", text="Frame", icon="RENDER_STILL").animation = False
        row.operator("selfcorrect.render", text="Animation", icon="RENDER_ANIMATION").animation = True
        if State.message:
            layout.label(text=State.message)
        if State.page:
            layout.operator("wm.path_open", text="Open Report", icon="URL").filepath = State.page


CLASSES = (
    SelfcorrectPreferences,
    SelfcorrectSettings,
    SELFCORRECT_OT_render,
    SELFCORRECT_OT_cancel,
    SELFCORRECT_PT_panel,
)


def register():
    """Called by Blender."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.selfcorrect = bpy.props.PointerProperty(type=SelfcorrectSettings)


def unregister():
    """Called by Blender; ends the programs that still run."""
    if State.job is not None:
        State.job.cancel()
        State.job = None
    del bpy.types.Scene.selfcorrect
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
