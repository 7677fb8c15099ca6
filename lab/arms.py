"""Parts of an arm of lab/full.py, each enabled by a key of its JSON. All survive the recorded step: they change the loss
once, at the prune, when recordings are made anew, or they write into tensors of the field between steps.

After the prune:
  "rmse": r        r of the L1 part of the loss becomes the root of the mean squared error (PSNR counts squares)
  "ssim": w        weight of SSIM in place of 0.2
  "bg": true       the background that tests show, in place of a random colour
  "drop": r        DropGaussian: a random share of the primitives, growing from 0 to r, is left out of each step, the others are
                   more opaque by 1 / (1 - r)
  "shrink": {p: a} multiplies parameter p (or "head", its weights) by 1 - a at each step, applied every tenth
  "decay": w       weight decay of the head, decoupled: its weights times 1 - w x rate at each step, applied every tenth
  "smooth": {p: m} every tenth step parameter p goes by a share m towards the weighted mean of 8 neighbours on the pruning graph
  "course": {p: [a, b]}  rates times a right after the prune, falling or rising exponentially to times b at the end
  "rates": {p: f}  learning rates times f; "freeze": {p: step} sets them to 0 from a step on
  "relocate": {"share": s, "every": k, "until": step, "views": v, "power": q}  the share s with the smallest blending weight over (v)
                   training views moves onto primitives drawn by weight x |error|^q, which are split along their longest axis
  "distil": {"views": v, "share": s, "reach": t}  s of the steps train on v images of the unpruned field, from cameras
                   between two neighbours (t: farthest share of the way, also sideways)
  "shift": s       (1: the grid of folded pixels shifts by at most a pixel) the head trains on windows that are s pixels smaller than the image, at a random place of each step
  "flip": axes     the head trains on mirrored images: each of these axes (0 rows, 1 columns) is flipped in half of the steps
  "pdrop": p       the features of each primitive are left out of a step with probability p, those of the others are larger by
                   1 / (1 - p); colours stay
  "fdrop": p       each feature is left out of a step with probability p, the others are larger by 1 / (1 - p)
  "oblur": s       the correction is blurred by a Gaussian of s pixels (3 x 3), in training and after
  "grid": u        in training the grid of folded pixels is shifted by 0 or 1 along each side, up to the share u of the steps after
                   the prune (true: all), in the share "grid_share" of these; "mirror_until": u  mirrored images up to a share
  "fblur": s       features are blurred by a Gaussian of s pixels, in training and after
  "average": k     mean of field and head over the last k steps; evaluated at the end beside the last state
Before it:
  "reg_warm": w    weights of opacities and scales while the field grows
  "fade": {"from": a, "factor": f}  the decision is made at step a; opacities of the dropped are multiplied by f every 50 steps
                   until the prune (prune-at), which then drops them without a merge
  "count": n       number of primitives that the prune keeps; "cap": n  most primitives while the field grows
"""
import math
import random
import sys
from dataclasses import replace

import torch

import sundae_ns.training.schedules as schedules
import sundae_ns.training.step as step_module
from sundae_ns.compensation import Window
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.relocation import split_evenly
from sundae_ns.gaussians.rotations import rotation_matrices
from sundae_ns.gaussians.surgery import keep, moments_of
from sundae_ns.pruning import PruningConfig, decide
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.scores import for_graph
from sundae_ns.rasterization import blending_weights
from sundae_ns.rendering.render import pass_options, render
from sundae_ns.rendering.source import LocalField, Primitives
from sundae_ns.training.losses import StepLosses

HEAD = "compensation"
render_module = sys.modules["sundae_ns.rendering.render"]  # the package has a function of this name


def patch_losses(spec):
    old, r, weight = StepLosses.__call__, spec.get("rmse", 0), spec.get("ssim")

    def losses(self, state, params, rgb, base, target, mask):
        if not state.pruning["num_prunes"]:
            terms = old(self, state, params, rgb, base, target, mask)
            if spec.get("reg_warm"):
                terms["reg_o"] = spec["reg_warm"] * params["opacities"].sigmoid().mean()
                terms["reg_s"] = spec["reg_warm"] * params["scales"].exp().mean()
            return terms
        own = self if weight is None else replace(self, ssim_weight=weight)
        terms = old(own, state, params, rgb, base, target, mask)
        if r:
            error = rgb - target if mask is None else (rgb - target) * mask
            rest = (error.square().mean() + 1e-8).sqrt() - error.abs().mean()
            terms["main_loss"] = terms["main_loss"] + (1 - own.ssim_weight) * r * rest
        if spec.get("reg"):
            terms["reg_o"] = spec["reg"] * params["opacities"].sigmoid().mean()
            terms["reg_s"] = spec["reg"] * params["scales"].exp().mean()
        return terms

    StepLosses.__call__ = losses


class Arm:
    def __init__(self, spec, trainer):
        self.spec, self.trainer = spec, trainer
        self.model, self.dm = trainer.pipeline.model, trainer.pipeline.datamanager
        self.state, self.steps = self.model.state, spec.get("end", 30000)
        self.pruned_at, self.factor, self.mask, self.novel = None, None, None, []
        self.mean, self.averaged, self.there = None, 0, None
        self.random = random.Random(spec.get("seed", 42))
        if "count" in spec:
            schedules.OneShotPruning.target = lambda _, n: min(spec["count"], n)
        if "cap" in spec:
            self.model.extensions[0].strategy.cap = spec["cap"]
        if spec.get("bg"):
            old = self.model._get_background_color
            self.model._get_background_color = lambda: self.model.shown_background if self.pruned else old()
        if spec.get("drop"):
            self._patch_draw()
        if spec.get("shift"):
            self._patch_window()
        if spec.get("fdrop"):
            self._patch_features()
        if spec.get("flip"):
            self._patch_flip()
        if spec.get("pdrop"):
            self._patch_primitives()
        if spec.get("fnoise"):
            self._patch_noise()
        if spec.get("fblur"):
            self._patch_blur()
        if spec.get("oblur"):
            self._patch_output()
        if spec.get("grid"):
            self._patch_grid()
        if "mirror_until" in spec:
            old_at = self.model.resolution
            until = lambda: (self.pruned_at or 0) + spec["mirror_until"] * (self.steps - (self.pruned_at or 0))
            self.model.resolution = lambda step: old_at(step) if step < until() else old_at(step)._replace(mirror=False)
        if spec.get("hold"):
            self._patch_hold()
        if "distil" in spec:
            self._patch_views()
        if "fade" in spec:
            self._patch_cut()

    @property
    def pruned(self):
        return self.state.pruning["num_prunes"] > 0

    # ------------------------------------------------------------------------------------------------ around a step

    @torch.no_grad()
    def before(self, step):
        spec = self.spec
        if "distil" in spec and not self.pruned and not self.novel and step >= self.model.config.pruning.prune_at:
            self._draw_novel()  # the last step before the prune
        if not self.pruned:
            return
        if self.pruned_at is None:
            self.pruned_at = step
            for name, factor in spec.get("rates", {}).items():
                self._rate(name, factor)
            self.begun = {name: [group["lr"] for group in self.state.optimizers[name].param_groups] for name in spec.get("course", {})}
        for name, (a, b) in spec.get("course", {}).items():
            t = (step - self.pruned_at) / max(self.steps - self.pruned_at, 1)
            for group, rate in zip(self.state.optimizers[name].param_groups, self.begun[name]):
                group["lr"] = rate * a ** (1 - t) * b**t
        for name, at in spec.get("freeze", {}).items():
            if step == at:
                self._rate(name, 0.0)
        if spec.get("drop"):
            opacities = self.state.field["opacities"]
            if self.factor is None or len(self.factor) != len(opacities):
                self.factor = torch.ones_like(opacities)
            kept = 1 - spec["drop"] * (step - self.pruned_at) / max(self.steps - self.pruned_at, 1)
            self.factor.bernoulli_(kept).div_(kept)
        if spec.get("pdrop"):
            opacities = self.state.field["opacities"]
            if self.there is None or len(self.there) != len(opacities):
                self.there = torch.ones_like(opacities)
            self.there.bernoulli_(1 - spec["pdrop"]).div_(1 - spec["pdrop"])
        if spec.get("grid"):
            left = step < self.pruned_at + float(spec["grid"]) * (self.steps - self.pruned_at)
            free = left and self.random.random() < spec.get("grid_share", 1)
            for flag in self.moved:
                flag.fill_(free and self.random.random() < 0.5)
        if spec.get("flip"):
            for flag in self.flips.values():
                flag.fill_(self.random.random() < 0.5)

    @torch.no_grad()
    def after(self, step):
        spec, field = self.spec, self.state.field
        fade = spec.get("fade")
        if fade and not self.pruned and step >= fade["from"]:
            if self.mask is None:
                self._decide()
            elif step % 50 == 0:
                value = field["opacities"].data
                faded = torch.logit((value.sigmoid() * fade["factor"]).clamp_min(1e-4))
                value.copy_(torch.where(self.mask[:, None], value, faded))
        if not self.pruned:
            return
        if step % 10 == 0:
            for name, rate in spec.get("shrink", {}).items():
                weights = [v for v in self.model.head.parameters() if v.ndim > 1] if name == "head" else [field[name]]
                for value in weights if name != "head" or self.state.head_enabled else []:
                    value.data.mul_(1 - 10 * rate)
            if spec.get("decay") and self.state.head_enabled:
                rate = self.state.optimizers[HEAD].param_groups[0]["lr"]
                for value in self.model.head.parameters():
                    if value.ndim > 1:
                        value.data.mul_(1 - 10 * rate * spec["decay"])
            if "smooth" in spec:
                self._smooth(step)
        again = spec.get("relocate")
        if again and self.pruned_at is not None and step < again["until"] and (step - self.pruned_at) % again["every"] == 499 % again["every"]:
            self._relocate(again)
        if "average" in spec and step % 10 == 0 and step >= self.steps - spec["average"]:
            self._average()
        if step % 10 == 0:
            for k in spec.get("means", []):
                if step >= self.steps - k:
                    self._average_over(k)

    def _rate(self, name, factor):
        optimizer, scheduler = self.state.optimizers[name], self.state.schedulers.get(name)
        for group in optimizer.param_groups:
            group["lr"] *= factor
        if scheduler is not None:
            scheduler.base_lrs = [rate * factor for rate in scheduler.base_lrs]

    # ----------------------------------------------------------------------------------------------- inputs of the head

    def _patch_window(self):
        old, arm, s = step_module.training_window, self, self.spec["shift"]

        def window(width, height, max_pixels, seed, *, mirror=False):
            found = old(width, height, max_pixels, seed, mirror=mirror)
            if not arm.state.head_enabled or width * height > max_pixels > 0:
                return found
            draw = random.Random(seed)
            return Window(draw.randint(0, s), draw.randint(0, s), width - s, height - s, found is not None and found.mirrored)

        step_module.training_window = window

    def _patch_features(self):
        old, p = render_module.compensate, self.spec["fdrop"]

        def compensate(head, base, splatted, background, *, training):
            if training:
                features = splatted.colors[..., 3:]
                kept = (torch.rand(features.shape[-1], device=features.device) >= p) / (1 - p)
                splatted = replace(splatted, colors=torch.cat([splatted.colors[..., :3], features * kept], dim=-1))
            return old(head, base, splatted, background, training=training)

        render_module.compensate = step_module.compensate = compensate

    def _patch_primitives(self):
        old, arm = LocalField.primitives, self

        def primitives(source, view, settings, *, features, colors=True, at=None):
            found = old(source, view, settings, features=features, colors=colors, at=at)
            if features and settings.training and arm.there is not None and len(arm.there) == len(found[FEATURES]):
                found[FEATURES] = found[FEATURES] * arm.there
            return found

        LocalField.primitives = primitives

    def _patch_blur(self):
        old, sigma = render_module.compensate, self.spec["fblur"]
        x = torch.arange(-3, 4, dtype=torch.float32)
        kernel = torch.exp(-0.5 * (x / sigma) ** 2)
        kernel = (kernel / kernel.sum()).to(self.state.device)

        def blurred(features):
            image = features.permute(2, 0, 1)[:, None]
            image = torch.nn.functional.conv2d(torch.nn.functional.pad(image, (3, 3, 0, 0), mode="replicate"), kernel.view(1, 1, 1, 7))
            image = torch.nn.functional.conv2d(torch.nn.functional.pad(image, (0, 0, 3, 3), mode="replicate"), kernel.view(1, 1, 7, 1))
            return image[:, 0].permute(1, 2, 0)

        def compensate(head, base, splatted, background, *, training):
            splatted = replace(splatted, colors=torch.cat([splatted.colors[..., :3], blurred(splatted.colors[..., 3:])], dim=-1))
            return old(head, base, splatted, background, training=training)

        render_module.compensate = step_module.compensate = compensate

    def _patch_output(self):
        old, sigma = render_module.compensate, self.spec["oblur"]
        side = math.exp(-0.5 / sigma**2)
        k = torch.tensor([side, 1.0, side])
        kernel = (k[:, None] * k / k.sum() ** 2).to(self.state.device).view(1, 1, 3, 3)

        def compensate(head, base, splatted, background, *, training):
            off = old(head, base, splatted, background, training=training) - base
            image = torch.nn.functional.pad(off.permute(2, 0, 1)[:, None], (1, 1, 1, 1), mode="replicate")
            return base + torch.nn.functional.conv2d(image, kernel)[:, 0].permute(1, 2, 0)

        render_module.compensate = step_module.compensate = compensate

    def _patch_grid(self):
        old = render_module.compensate
        self.moved = [torch.zeros((), dtype=torch.bool, device=self.state.device) for _ in range(2)]

        def pick(image, axis, first, second):  # by flags on the device, for recorded steps
            n = image.shape[axis] - 1
            return torch.where(self.moved[axis], image.narrow(axis, first, n), image.narrow(axis, second, n))

        def pad(image):
            return pick(pick(torch.nn.functional.pad(image, (0, 0, 1, 1, 1, 1)), 0, 0, 1), 1, 0, 1)

        def compensate(head, base, splatted, background, *, training):
            if not training:
                return old(head, base, splatted, background, training=training)
            seen = replace(splatted, colors=pad(splatted.colors), alpha=pad(splatted.alpha))
            return pick(pick(old(head, pad(base), seen, background, training=True), 0, 1, 0), 1, 1, 0)

        render_module.compensate = step_module.compensate = compensate

    def _patch_noise(self):
        old, p = render_module.compensate, self.spec["fnoise"]

        def compensate(head, base, splatted, background, *, training):
            if training:
                features = splatted.colors[..., 3:]
                spread = features.detach().std(dim=(-3, -2), keepdim=True)
                noisy = features + p * spread * torch.randn_like(features)
                splatted = replace(splatted, colors=torch.cat([splatted.colors[..., :3], noisy], dim=-1))
            return old(head, base, splatted, background, training=training)

        render_module.compensate = step_module.compensate = compensate

    def _patch_hold(self):
        """hold: {"share": s, "every": k or 0, "only": bool, "until": share of the run after the prune}"""
        options, arm, indices = self.spec["hold"], self, list(self.dm.train_indices)
        state = {"set": set(), "drawn": -1}
        flag = torch.ones((), device=self.state.device)  # 1: the field learns; 0: the head alone
        headed = torch.ones((), device=self.state.device)
        old = LocalField.training_view

        def seen(source, at, make, index):
            step = arm.state.step
            if arm.pruned_at is None:
                return old(source, at, make, index)
            t = (step - arm.pruned_at) / max(arm.steps - arm.pruned_at, 1)
            turn = (step - arm.pruned_at) // options["every"] if options.get("every") else 0
            if turn != state["drawn"]:
                state["drawn"] = turn
                rest = [i for i in indices if i not in state["set"]] if turn else indices
                state["set"] = set(arm.random.sample(rest, round(options["share"] * len(indices))))
            held = index in state["set"] and t < options.get("until", 1.0)
            flag.fill_(0.0 if held else 1.0)
            headed.fill_(1.0 if held or not options.get("only") or t >= options.get("until", 1.0) else 0.0)
            return old(source, at, make, index)

        LocalField.training_view = seen
        primitives = LocalField.primitives

        def some(source, view, settings, *, features, colors=True, at=None):
            found = primitives(source, view, settings, features=features, colors=colors, at=at)
            if settings.training:
                for key in list(found):
                    found[key] = torch.lerp(found[key].detach(), found[key], flag) if torch.is_tensor(found[key]) and found[key].requires_grad else found[key]
            return found

        LocalField.primitives = some
        if options.get("only"):
            for p in self.model.head.parameters():
                p.register_hook(lambda g: g * headed)

    def _patch_flip(self):
        old = render_module.compensate
        self.flips = {axis: torch.zeros((), dtype=torch.bool, device=self.state.device) for axis in self.spec["flip"]}

        def turn(image):
            for axis, flag in self.flips.items():
                image = torch.where(flag, image.flip(axis), image)
            return image

        def compensate(head, base, splatted, background, *, training):
            if not training:
                return old(head, base, splatted, background, training=training)
            seen = replace(splatted, colors=turn(splatted.colors), alpha=turn(splatted.alpha))
            return turn(old(head, turn(base), seen, background, training=training))

        render_module.compensate = step_module.compensate = compensate

    # ------------------------------------------------------------------------------------------------------- dropping

    def _patch_draw(self):
        arm = self

        def wrapped(old):
            def draw(primitives, *args, **kwargs):
                if args[2].training and arm.factor is not None and len(arm.factor) == len(primitives["opacities"]):
                    o = torch.logit((primitives["opacities"].sigmoid() * arm.factor).clamp(1e-6, 0.999))
                    primitives = Primitives({**primitives, "opacities": o})
                return old(primitives, *args, **kwargs)

            return draw

        render_module.draw, step_module.draw = wrapped(render_module.draw), wrapped(step_module.draw)

    # ------------------------------------------------------------------------------------------------------ smoothing

    def _smooth(self, step):
        field = self.state.field
        if not hasattr(self, "graph") or step % 1000 == 0 or len(self.graph.indices) != field.num_primitives:
            config = replace(self.model.config.pruning, num_neighbors=8, edges="appearance")
            self.graph = field_graph(for_graph(field, config), config)
            self.weights = (self.graph.weights / self.graph.dw.clamp_min(1e-12)[:, None]).float()
            self.has = (self.graph.dw > 0).to(self.weights)
        for name, share in self.spec["smooth"].items():
            value = field[name].data
            flat = value.reshape(len(value), -1)
            mean = torch.zeros_like(flat)
            for k in range(self.graph.indices.shape[1]):
                mean.addcmul_(self.weights[:, k, None], flat[self.graph.indices[:, k]])
            value.copy_((flat + share * self.has[:, None] * (mean - flat)).reshape(value.shape))

    # ----------------------------------------------------------------------------------------------------- relocation

    def _relocate(self, options):
        model, state, field = self.model, self.state, self.state.field
        settings, n = model.render_settings(training=False), self.state.field.num_primitives
        weight, error = (torch.zeros(n, device=state.device) for _ in range(2))
        indices = self.dm.train_indices
        for index in self.random.sample(indices, min(options.get("views", 100000), len(indices))):
            camera, batch = self.dm._view(index)
            view = model.view_of(camera)
            images, _ = render(model.source, view, model.shown_background, settings, depth=False)
            off = (images["rgb"] - model.target(batch["image"], model.shown_background)).abs().mean(dim=2)
            primitives = model.source.primitives(view, settings, features=False, colors=False)
            weight += blending_weights(**pass_options(primitives, view, settings))
            error += blending_weights(pixels=off ** options.get("power", 1.0), **pass_options(primitives, view, settings))
        count = int(options["share"] * n)
        donors = weight.argsort()[:count]
        error[donors] = 0
        sources = torch.multinomial(error.clamp_min(0) + 1e-12, count, replacement=False)
        print("RELOCATE", state.step, count, "weight of donors", float(weight[donors].sum() / weight.sum()), "error of sources",
              float(error[sources].sum() / error.sum()), flush=True)
        # MCMC's split, which keeps the image but for 3 to 12%, with the two apart along the longest axis, for 6 to 12%.
        scales = field["scales"].data
        longest = scales[sources].argmax(dim=1)
        axes = rotation_matrices(field["quats"].data[sources])[torch.arange(count, device=longest.device), :, longest]
        opacity, narrower = split_evenly(
            field["opacities"].data[sources].sigmoid().squeeze(1), scales[sources].exp(), torch.full_like(longest, 2)
        )
        shift = 0.35 * axes * narrower.gather(1, longest[:, None])
        opacity = torch.logit(opacity.clamp(1e-4, 1 - 1e-6))[:, None]
        for name, value in field.items():
            value.data[donors] = value.data[sources]
            for moment in moments_of(state.optimizers, name, value).values():
                moment[donors] = moment[sources]
        for rows, sign in ((donors, 1.0), (sources, -1.0)):
            field["means"].data[rows] += sign * shift
            field["scales"].data[rows] = narrower.log()
            field["scales"].data[rows, longest] += math.log(0.95)
            field["opacities"].data[rows] = opacity
            for name in ("means", "scales", "opacities"):
                moments_of(state.optimizers, name, field[name])["exp_avg"][rows] = 0

    # --------------------------------------------------------------------------------------------------- distillation

    def _draw_novel(self):
        model, options, cameras = self.model, self.spec["distil"], self.dm.train_dataset.cameras
        indices, model_training = self.dm.train_indices, model.training
        for index in indices:
            self.dm.cached_train[index]  # undistortion changes the camera
        poses = cameras.camera_to_worlds.cpu()
        centres = poses[:, :, 3]
        settings = model.render_settings(training=False).without_head()
        model.eval()
        for _ in range(options["views"]):
            a = self.random.choice(indices)
            near = [i for i in (centres - centres[a]).norm(dim=1).argsort().tolist() if i in set(indices)][1:5]
            b, t = self.random.choice(near), self.random.uniform(0.15, options.get("reach", 0.5))
            pose = (1 - t) * poses[a] + t * poses[b]
            step = float((centres[a] - centres[b]).norm())
            pose[:, 3] += 0.15 * step * torch.randn(3, generator=torch.Generator().manual_seed(self.random.randrange(1 << 30)))
            u, _, v = torch.linalg.svd(pose[:, :3])
            pose[:, :3] = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ v))])) @ v
            camera = cameras[a : a + 1]
            camera.camera_to_worlds = pose[None].to(cameras.camera_to_worlds)
            camera.metadata = {k: w for k, w in (camera.metadata or {}).items() if k != "cam_idx"}
            images, _ = render(model.source, model.view_of(camera), model.shown_background, settings, depth=False)
            self.novel.append((camera, {"image": (images["rgb"] * 255).round().to(torch.uint8)}))
        model.train(model_training)
        print("NOVEL", len(self.novel), flush=True)

    def _patch_views(self):
        old, share = self.dm.next_train, self.spec["distil"]["share"]

        def next_train(step):
            draw = random.Random(f"{self.spec.get('seed', 42)}-{step}")
            if self.pruned and self.novel and draw.random() < share:
                camera, batch = draw.choice(self.novel)
                return camera, dict(batch)
            return old(step)

        self.dm.next_train = next_train

    # --------------------------------------------------------------------------------------------------------- fading

    def _decide(self):
        pruning, run = self.model.extensions[1], self._run()
        n = self.state.field.num_primitives
        config: PruningConfig = pruning.schedule.config
        decision = decide(self.state.field, config, lambda: pruning._contribution(run), count=pruning.schedule.target(n))
        self.mask = decision.mask.to(self.state.device)

    def _run(self):
        for callback in self.trainer.callbacks:
            owner = getattr(callback.func, "__self__", None)
            if hasattr(owner, "training_views"):
                return owner
        raise SystemExit("no run among the callbacks")

    def _patch_cut(self):
        old, arm = schedules.cut, self

        def cut(params, optimizers, state, config, contribution, *, step, count, strategy_state=None):
            if arm.mask is None or len(arm.mask) != len(params["means"]):
                return old(params, optimizers, state, config, contribution, step=step, count=count, strategy_state=strategy_state)
            faded = params["opacities"].detach().sigmoid()[~arm.mask]
            print("FADED: opacity of the dropped, quantiles", faded.float().quantile(torch.tensor([0.1, 0.5, 0.9, 0.99], device=faded.device)).tolist(), flush=True)
            states = [state] if strategy_state is None else [state, strategy_state]
            from sundae_ns.pruning.decision import Decision

            keep(params, optimizers, states, arm.mask)
            state["pruned_at"] = step
            state["num_prunes"] += 1
            return Decision(arm.mask, int(arm.mask.sum()), 0)

        schedules.cut = cut

    # ------------------------------------------------------------------------------------------------------ averaging

    def _weights(self):
        head = [] if self.model.head is None else list(self.model.head.parameters())
        return [value.data for value in (*self.state.field.values(), *head) if value.numel()]

    def _average(self):
        weights = self._weights()
        if self.mean is None or [v.shape for v in self.mean] != [v.shape for v in weights]:
            self.mean, self.averaged = [v.clone() for v in weights], 0
        self.averaged += 1
        torch._foreach_lerp_(self.mean, weights, 1 / self.averaged)

    def _average_over(self, k):
        weights = self._weights()
        self.means = getattr(self, "means", {})
        if k not in self.means or [v.shape for v in self.means[k][1]] != [v.shape for v in weights]:
            self.means[k] = [0, [v.clone() for v in weights]]
        self.means[k][0] += 1
        torch._foreach_lerp_(self.means[k][1], weights, 1 / self.means[k][0])

    def swap(self):
        """Exchange the last state and the mean."""
        for value, mean in zip(self._weights(), self.mean):
            kept = value.clone()
            value.copy_(mean)
            mean.copy_(kept)
