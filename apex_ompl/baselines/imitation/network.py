"""Transformer policy: the next states of a path from the present one, the goal and the obstacles."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from apex_ompl.baselines.imitation.config import NetworkConfig
from apex_ompl.model.config import WORKSPACE_CENTER
from apex_ompl.model.geometry import SHAPES
from apex_ompl.training.conditions import Conditions

OBSTACLE_FEATURES = len(SHAPES) + 3 + 9 + 3  # one-hot shape, position, rotation matrix, size
FREQUENCIES = 4  # of the features of the share of time
TIME_FEATURES = 1 + 2 * FREQUENCIES
EXPANSION = 4  # width of the hidden layer of a block's MLP, in widths of the tokens


class Block(nn.Module):
    """Layer of a transformer encoder with layer normalization before attention and MLP (Xiong et al. 2020)."""

    def __init__(self, width: int, heads: int) -> None:
        """Make a layer with random weights."""
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, EXPANSION * width), nn.GELU(), nn.Linear(EXPANSION * width, width))

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Return tokens after the layer, shape (B, T, width); ``mask`` (B, 1, T, T) is True where one sees another."""
        batch, count, width = x.shape
        qkv = self.qkv(self.norm1(x)).reshape(batch, count, 3, self.heads, width // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)  # (B, heads, T, width / heads) each
        seen = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        x = x + self.out(seen.transpose(1, 2).reshape(batch, count, width))
        found: Tensor = x + self.mlp(self.norm2(x))
        return found


class PolicyNetwork(nn.Module):
    """Policy pi(q_{k+1..k+H} | q_k, goal, obstacles, k / K) as a transformer encoder over tokens.

    Tokens are those of the left arm's, the right arm's and the hands' state, of their goals, and of the obstacles:
    one for each of a set, without an order, or one for the obstacle point of the paper. The share of time is added to
    the tokens of the state. Tokens of goals and obstacles do not see those of states, so that windows of one path, at
    several times, share them. From the last layer's tokens of the state a linear layer predicts what the next states
    deviate from the straight line that reaches the goal at time 1 at even speed, in standard deviations of the data:

        q_{k+j} = q_k + min(1, j / (K - k)) (goal - q_k) + scale_j * out_j.

    Attributes:
        config: Its configuration.
        mean: Mean state of the data, shape (dof,) [rad].
        deviation: Standard deviation of the states, shape (dof,) [rad].
        scale: Standard deviation of the predicted quantity, shape (chunk, dof) [rad].
    """

    mean: Tensor
    deviation: Tensor
    scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        """Make a network with random weights."""
        super().__init__()
        self.config = config
        width, groups = config.width, config.groups
        self.states = nn.ModuleList(nn.Linear(2 * len(group) + TIME_FEATURES, width) for group in groups)
        self.goals = nn.ModuleList(nn.Linear(len(group), width) for group in groups)
        size = OBSTACLE_FEATURES if config.obstacles == "set" else 3
        self.obstacle = nn.Sequential(nn.Linear(size, width), nn.GELU(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(Block(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(len(groups) * width, config.chunk * config.dof)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.register_buffer("mean", torch.zeros(config.dof))
        self.register_buffer("deviation", torch.ones(config.dof))
        self.register_buffer("scale", torch.ones(config.chunk, config.dof))

    def forward(self, conditions: Conditions, state: Tensor, time: Tensor) -> Tensor:
        """Return the next states, shape (B, W, chunk, dof) [rad].

        Args:
            conditions: Goals and obstacles of B paths; starts are not used.
            state: Present states, W of each path, shape (B, W, dof) [rad].
            time: How many steps of the clock they are after the start of the path, shape (B, W), integers.
        """
        line = self.line(conditions.goal, state, time)
        fixed, there = self._fixed_tokens(conditions)
        batch, windows = time.shape
        moving = self._state_tokens(conditions.goal, state, time)  # (B, W * groups, width)
        x, mask = torch.cat([fixed, moving], dim=1), self._mask(there, windows)
        for block in self.blocks:
            x = block(x, mask)
        read = self.norm(x[:, fixed.shape[1] :]).reshape(batch, windows, -1)
        out = self.head(read).float().reshape(line.shape)
        found: Tensor = line + self.scale * out
        return found

    def line(self, goal: Tensor, state: Tensor, time: Tensor) -> Tensor:
        """Return states of the straight lines that reach goals (B, dof) at the end of the clock, (B, W, chunk, dof)."""
        left = (self.config.clock - 1 - time).clamp(min=1)[..., None]  # (B, W, 1)
        steps = torch.arange(1, self.config.chunk + 1, device=state.device)
        share = (steps / left).clamp(max=1.0)[..., None]  # (B, W, chunk, 1)
        return state[:, :, None] + share * (goal[:, None] - state)[:, :, None]

    def _fixed_tokens(self, conditions: Conditions) -> tuple[Tensor, Tensor]:
        """Return tokens of goals and obstacles, (B, C, width), and which of them are there, (B, C)."""
        goal = (conditions.goal - self.mean) / self.deviation
        tokens = [embed(goal[:, list(g)]) for embed, g in zip(self.goals, self.config.groups, strict=True)]
        center = goal.new_tensor(WORKSPACE_CENTER)
        if self.config.obstacles == "point":
            seen = self.obstacle(conditions.point - center)[:, None]
            mask = torch.ones(len(goal), 1, dtype=torch.bool, device=goal.device)
        else:
            kind = functional.one_hot(conditions.shape, len(SHAPES)).to(goal.dtype)
            turned = conditions.rotation.flatten(2)
            features = torch.cat([kind, conditions.position - center, turned, conditions.size], dim=2)
            seen, mask = self.obstacle(features), conditions.mask
        there = torch.cat([mask.new_ones(len(goal), len(tokens)), mask], dim=1)
        return torch.cat([torch.stack(tokens, dim=1), seen], dim=1), there

    def _state_tokens(self, goal: Tensor, state: Tensor, time: Tensor) -> Tensor:
        """Return tokens of states, shape (B, W * groups, width), those of a window side by side."""
        share = (time / (self.config.clock - 1)).to(state.dtype)[..., None]
        angles = math.pi * share * torch.arange(1, FREQUENCIES + 1, device=state.device)
        times = torch.cat([share, angles.sin(), angles.cos()], dim=2)
        here, left = (state - self.mean) / self.deviation, (goal[:, None] - state) / self.deviation
        tokens = []
        for embed, group in zip(self.states, self.config.groups, strict=True):
            joints = list(group)
            tokens.append(embed(torch.cat([here[..., joints], left[..., joints], times], dim=2)))
        return torch.stack(tokens, dim=2).flatten(1, 2)

    def _mask(self, there: Tensor, windows: int) -> Tensor:
        """Return which token sees which, shape (B, 1, T, T): a state its window and what is fixed; this only itself."""
        batch, fixed = there.shape
        groups = len(self.config.groups)
        count = fixed + windows * groups
        mask = there.new_zeros(batch, count, count)
        mask[:, :, :fixed] = there[:, None]
        window = torch.arange(windows, device=there.device).repeat_interleave(groups)
        mask[:, fixed:, fixed:] = window[:, None] == window
        return mask[:, None]
