"""One reconstruction between two iterations, and what an iteration does."""

from __future__ import annotations

from dataclasses import replace

import torch

from difftetvr.capture.capture import Capture
from difftetvr.capture.truth import Truth
from difftetvr.errors import DiffTetError
from difftetvr.fitting.beginning.initial_mesh import Start, load_start
from difftetvr.fitting.beginning.requirements import device_for, require_fittable
from difftetvr.fitting.beginning.starting_mesh import starting_mesh
from difftetvr.fitting.cameras.alignment import StillWorld, align_held_out
from difftetvr.fitting.cameras.refined import RefinedCameras
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.gradients import ViewGradients
from difftetvr.fitting.parameters import FieldParameters
from difftetvr.fitting.positions import VertexOptimizer
from difftetvr.fitting.processes import ALONE, Processes
from difftetvr.fitting.records.checkpoint import Checkpoint, describe_capture, require_same_capture
from difftetvr.fitting.records.evaluation import Evaluation, compared, seen_and_true
from difftetvr.fitting.records.history import History
from difftetvr.fitting.records.unread import Unread
from difftetvr.fitting.refinement import Refinement, Situation, Strategy
from difftetvr.fitting.refinement.adaptive_run import AdaptiveRun
from difftetvr.fitting.refinement.iterate_mean import IterateMean
from difftetvr.fitting.refinement.pixels import Judgement
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering.gauss_newton import HatChoice, ImageModel

_READ_EVERY = 25
"""Iterations from one question to a GPU how they went to the next: the host waits for each answer."""
_VERTICES = "vertices"  # name of their mean
_CAMERAS = "cameras."  # prefix of their state in a checkpoint


class Trainer(AdaptiveRun):
    """A reconstruction between two iterations; its state alone decides how it goes on.

    Attributes:
        capture: Images and cameras.
        config: Options, those that were left open chosen for the capture.
        strategy: How the mesh is refined; None: not at all.
        budget: Cells that the mesh may have.
        parameters: Colours and densities under optimisation.
        positions: Vertex positions under optimisation; None where they are fixed.
        cameras: Cameras under optimisation; None where they are known.
        iteration: Iterations done.
        history: What happened so far; on a GPU it may lack the latest iterations, see :meth:`catch_up`.
        repair: What mending the initial mesh changed, in words; None where it was not mended.
        starts_from_field: Whether the initial mesh brought colours and densities along.
        processes: Those that fit together; all of them hold the same state.
    """

    def __init__(
        self,
        capture: Capture,
        config: FitConfig,
        mesh: TetMesh | None = None,
        strategy: Strategy | None = None,
        processes: Processes = ALONE,
    ) -> None:
        """Prepares the first iteration.

        Args:
            capture: Images and cameras.
            config: Options.
            mesh: Mesh to begin with; default: the file or the starting mesh that the options ask for.
            strategy: How to refine it; default: as the options say.
            processes: Those that fit together; default: this one alone.

        Raises:
            CaptureError: The background needs alpha that the capture lacks.
            FitError: The device does not exist or cannot move vertices, a strategy would refine a field on cells, or
                the initial mesh does not suit the options or the images.
            MeshError: The file of the initial mesh cannot be read or holds an invalid mesh, or the grid is too large.
        """
        config = config.for_capture(capture).for_processes(processes.count)
        strategy = strategy or config.strategy()
        require_fittable(capture, config, strategy)
        self.capture = capture
        self.config = config
        self.strategy = strategy
        self.processes = processes
        start = _start(capture, config, strategy, mesh)
        self.repair = start.repair
        self.starts_from_field = start.field is not None
        self._mesh = start.mesh.to(device=device_for(config, strategy))
        self.positions = VertexOptimizer(self._mesh, config.motion) if config.move else None
        self.budget = self._budget(mesh is not None or config.grid is not None or config.initial_mesh is not None)
        units = capture.density_units_at(self._sites())
        self.parameters = FieldParameters(self._mesh, config, units, start.field)
        self._free_space = capture.free_space(config.free_space or 0.0)
        self._keep_free()
        self.iteration = 0
        self.history = History()
        self._unread = Unread()
        self._mean = IterateMean(0.0 if strategy is None else config.averaged)
        self._train_views, self._test_views = capture.train_indices.tolist(), capture.test_indices.tolist()
        self._truth = Truth(capture, self._mesh.vertices.device).keep(self._train_views + self._glanced_views())
        self.cameras = _cameras(capture, config)
        self._truth.cameras = None if self.cameras is None else self.cameras.known
        self._gradients = ViewGradients(self._truth, config, self.parameters, processes, self.cameras)
        self._capture_description = describe_capture(capture)

    def step(self) -> None:
        """One iteration: refines the mesh where that is due, renders views, moves parameters and vertices.

        Raises:
            FitError: The loss is not finite; on a GPU, one of the last iterations' may have been it.
        """
        try:
            self._iterate()
        except DiffTetError:
            self.catch_up()  # what follows a loss that is not finite is no reason, but what came of it
            raise

    def catch_up(self) -> None:
        """Completes the history by what a GPU knows of the latest iterations, which is waited for.

        Raises:
            FitError: The loss of one of them is not finite.
        """
        self._unread.read_errors(self.history)
        self._unread.read_moves(self.history)

    def _iterate(self) -> None:
        self._refine_if_due()
        rate = self._motion_rate()
        mesh = self._moving_mesh(rate)
        batch = [self._train_views[k] for k in self.config.views_at(self.iteration, len(self._train_views))]
        self._unread.add(self.iteration, *self._gradients.gather(mesh, batch, self.iteration))
        is_read = self._is_read()
        if is_read:
            self._unread.read_errors(self.history)
        self.parameters.step(self.config.rate_at(self.iteration), self.config.haze_penalty)
        self._move(rate)
        if self.cameras is not None:
            self.cameras.step(batch, self.iteration / self.config.steps)
        if is_read:
            self._unread.read_moves(self.history)
        self._mean.add(self._iterate_now())
        self.iteration += 1
        if self.iteration == self.config.steps:
            self._keep_free()

    def evaluate(self, views: list[int], similarity: bool = True) -> Evaluation:
        """Image quality of the reconstruction as it is now; each view is rendered by one of the processes.

        Args:
            views: Indices of the views to compare.
            similarity: Whether SSIM is wanted, too.
        """
        mesh, field, background = self.mesh, self.field(), self.config.evaluation_background()
        shared = self.processes.share(views)
        own = [compared(mesh, field, self._truth, [view], background, similarity).row for view in shared]
        return Evaluation.of_rows(self.processes.gathered(own, len(views), 3))

    def _mean_psnr(self, views: list[int]) -> float | None:
        return self.evaluate(views, similarity=False).mean_psnr

    def field(self) -> Field:
        """Colours and densities as they are now, detached."""
        return self.parameters.detached_field()

    def _seen_and_true(self, view: int) -> tuple[torch.Tensor, torch.Tensor]:
        return seen_and_true(self.mesh, self.field(), self._truth, view, self.config.evaluation_background())

    def align(self, views: list[int]) -> None:
        """Moves held-out cameras to where their images fit best, where cameras are refined."""
        if self.cameras is None or not self.config.refine_poses:
            return
        background = self.config.evaluation_background()
        world = StillWorld(self.mesh, self.field(), self._truth, background, self.config.deterministic)
        align_held_out(self.cameras, self.config.cameras, world, views, self.processes)

    def require_agreement(self) -> None:
        """Checks that all processes have come to the same state.

        Raises:
            FitError: They have not.
        """
        if self.processes.count > 1:
            self.processes.require_same(
                self.checkpoint().digest(),
                f"The processes have come to different meshes after {self.iteration} iterations; start all of them "
                "with the same command, files and versions, on machines of one kind.",
            )

    def checkpoint(self) -> Checkpoint:
        """The state, to be saved.

        Raises:
            FitError: A loss on the way to it is not finite.
        """
        self.catch_up()
        tensors = self._mesh_state() | self.parameters.state() | self._mean.state(self._iterate_now())
        if self.cameras is not None:
            tensors |= {_CAMERAS + name: tensor for name, tensor in self.cameras.state().items()}
        strategy = type(self.strategy).__name__
        return Checkpoint(
            self.iteration,
            self.config,
            self._capture_description,
            tensors,
            self.budget,
            strategy,
            self.history,
            self.repair,
        )

    @staticmethod
    def resume(
        capture: Capture,
        config: FitConfig,
        checkpoint: Checkpoint,
        strategy: Strategy | None = None,
        processes: Processes = ALONE,
    ) -> Trainer:
        """Goes on from a checkpoint.

        With more or fewer iterations than its run was to have, rates go on as they would at this point of such a run.

        Raises:
            FitError: The checkpoint is of a run with other options or images, lacks something, or has come further than
                the options ask for.
        """
        # However many processes go on: the run stays what it is.
        saved = checkpoint.config
        averaging = saved.averaged if config.averaging is None else config.averaging
        config = replace(config, batch_views=config.batch_views or saved.batch, averaging=averaging)
        saved.require_same_run(config.for_capture(capture))
        trainer = Trainer(capture, config, checkpoint.mesh(), strategy, processes)
        require_same_capture(checkpoint.capture, trainer._capture_description)
        checkpoint.require_strategy(type(trainer.strategy).__name__)
        trainer._go_on_from(checkpoint)
        trainer._mean.restore(checkpoint.tensors, trainer._iterate_now())
        trainer.parameters.restore(checkpoint.tensors)
        if trainer.cameras is not None:
            trainer.cameras.restore({k.removeprefix(_CAMERAS): v for k, v in checkpoint.tensors.items()})
        trainer.repair = checkpoint.repair
        return trainer

    def _budget(self, mesh_is_given: bool) -> int:
        """The options' cells; a given mesh is its own budget, unless the strategy is to make it grow."""
        budget = self.config.budget
        if not mesh_is_given:
            return budget
        grows = self.strategy is not None and self.strategy.initial_cells(budget) < budget
        return max(budget if grows else 0, self._mesh.num_cells)

    def _sites(self) -> torch.Tensor:
        """(N, 3) positions of the vertices, or centres of the cells, that the parameters belong to."""
        mesh = self.mesh
        return mesh.vertices if self.config.location == "vertex" else mesh.vertices[mesh.tets.long()].mean(1)

    def _is_read(self) -> bool:
        """Whether the history learns now how this iteration went."""
        is_last = self.iteration + 1 == self.config.steps
        return self._truth.device.type == "cpu" or self.iteration % _READ_EVERY == 0 or is_last

    def _refine_if_due(self) -> None:
        if self.strategy is None or not self.strategy.is_due(self._moment()):
            return
        self.catch_up()
        self._even_out()
        with self.processes.in_order():
            self._refine(self.strategy)
        self.require_agreement()

    def _refine(self, strategy: Strategy) -> None:
        judgement, mesh = self._judgement(self._judged_views, self._judged_pixels), self.mesh
        unit = self.capture.density_unit

        def model(hats: HatChoice | None = None) -> ImageModel:
            field, deterministic = self.field(), self.config.deterministic
            hats = (hats or HatChoice()).from_density_unit(unit)
            return judgement.model(mesh, field, deterministic, hats).with_density_unit(unit)

        values = self.parameters.values(unit)
        situation = Situation(mesh, values, self._moment(), model, self._color_gradients, self._free_space)
        judges = judgement.some()
        self._refine_by(strategy, situation, lambda: judges.error(self.mesh, self.field()))

    def _judgement(self, views: int, pixels: float) -> Judgement:
        """What a refinement is judged on."""
        positions = self.config.refinement_views_at(self.iteration, views, len(self._train_views))
        judgement = Judgement.of(
            self._truth,
            [self._train_views[position] for position in positions],
            self.mesh,
            self.config.background_at(self.iteration),
            self.config.refinement_random(self.iteration),
            pixels,
            self.config.batch,
            self.processes,
        )
        # Colours by direction are known for rays that start at one point.
        return judgement if self.parameters.harmonics is not None else judgement.together()

    def _iterate_now(self) -> dict[str, torch.Tensor]:
        """What is learned on the vertices, and where these are if they move."""
        positions = {_VERTICES: self.positions.mesh.vertices} if self.positions else {}
        return self.parameters.leaves() | positions

    def _even_out(self) -> None:
        """Lets values, and vertices that may move now, be their means over the iterations since the last refinement."""
        means = self._mean.means
        places = means.pop(_VERTICES, None)
        if self.positions and places is not None and self._motion_rate() is not None:
            self.positions.move_to(places)
        leaves = self.parameters.leaves()
        with torch.no_grad():
            for name, mean in means.items():
                leaves[name].copy_(mean)
        self._mean.begin_anew()

    def _apply(self, refinement: Refinement) -> None:
        for change in refinement.changes:
            self.parameters.carry(change)
            self._adopt(change)
        self._keep_free()
        if refinement.surplus is not None:
            self.parameters.add(refinement.surplus, self.capture.density_unit)

    def _keep_free(self) -> None:
        """Empties what is in free space now, also what has moved there."""
        on_vertices = self.config.location == "vertex"
        free = self._free_space
        self.parameters.keep_free(free.vertices_of(self.mesh) if on_vertices else free.contains(self._sites()))

    def _color_gradients(self) -> torch.Tensor:
        return self._gradients.by_colors(self.mesh, self._train_views, self.iteration)


def _start(capture: Capture, config: FitConfig, strategy: Strategy | None, mesh: TetMesh | None) -> Start:
    if mesh is not None:
        return Start(mesh)
    if config.initial_mesh is not None:
        return load_start(capture, config, strategy)
    return Start(starting_mesh(capture, config, strategy))


def _cameras(capture: Capture, config: FitConfig) -> RefinedCameras | None:
    if not config.refines_cameras:
        return None
    return RefinedCameras(capture, config.cameras, config.refine_poses, config.refine_intrinsics)
