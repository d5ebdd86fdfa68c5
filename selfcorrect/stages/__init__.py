"""The stages, a file each: its mathematics and, at the end, the :class:`Stage`. A new one is a line in ``STAGES``."""

from selfcorrect.errors import SettingsError
from selfcorrect.settings import Settings
from selfcorrect.stages.core.stage import Core
from selfcorrect.stages.deep_combiner import DeepCombinerStage
from selfcorrect.stages.deep_combiner_4 import DeepCombiner4
from selfcorrect.stages.james_stein import JamesStein
from selfcorrect.stages.neural_james_stein import NeuralJamesStein
from selfcorrect.stages.regression import Regression
from selfcorrect.stages.stage import Stage

__all__ = ["STAGES", "opened"]

STAGES: dict[str, type[Stage]] = {
    stage.name: stage for stage in (Regression, Core, JamesStein, NeuralJamesStein, DeepCombinerStage, DeepCombiner4)
}
"""By the names that the settings take."""


def opened(settings: Settings) -> tuple[Stage, ...]:
    """The stages that the settings ask for, in order, with their weights.

    Raises:
        SettingsError: a stage stands where it cannot.
        FileError: weights are missing or do not fit.
    """
    for position, name in enumerate(settings.stage_names):
        if position and STAGES[name].first_only:
            raise SettingsError(
                f"expected {name} as the first stage, as it reads what the denoiser gave, but got {settings.stages!r}"
            )
    return tuple(STAGES[name](settings) for name in settings.stage_names)
