# SPDX-License-Identifier: Apache-2.0
"""Segmentation networks of the usual layouts and sizes of inputs and outputs, with random weights: YOLO-seg with three
heads of 640 px, and SAM's encoder of 1024 px with a decoder of its full size."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import nn
from torch.nn import functional

STRIDES, WIDTHS, PROTOTYPES, CLASSES, BINS = (8, 16, 32), (32, 64, 128), 32, 80, 16
ANCHORS = ((10, 13, 16, 30, 33, 23), (30, 61, 62, 45, 59, 119), (116, 90, 156, 198, 373, 326))
"""Widths and heights of v5's three boxes of each stride, px."""


def spread(module: nn.Module) -> None:
    """Random weights that keep the size of values from layer to layer."""
    if isinstance(module, (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)):
        nn.init.kaiming_normal_(module.weight)


def block(inputs: int, outputs: int, stride: int = 1) -> nn.Module:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.SiLU())


class RandomYolo(nn.Module):
    """Of version 5 (anchors and objectness) or of 8 and 11 (distances to the sides as distributions).

    Args:
        bias: logit that is added to those of scores.
    """

    def __init__(self, version: int, bias: float = 0) -> None:
        super().__init__()
        self.version, self.bias = version, bias
        self.stem = nn.Sequential(block(3, 8, 2), block(8, 16, 2), block(16, WIDTHS[0], 2))
        self.down = nn.ModuleList([block(WIDTHS[0], WIDTHS[1], 2), block(WIDTHS[1], WIDTHS[2], 2)])
        self.prototypes = nn.Sequential(
            nn.ConvTranspose2d(WIDTHS[0], 32, 2, 2), block(32, 32), nn.Conv2d(32, PROTOTYPES, 1)
        )
        outputs = 3 * (5 + CLASSES + PROTOTYPES) if version == 5 else 4 * BINS + CLASSES + PROTOTYPES
        self.heads = nn.ModuleList(nn.Conv2d(width, outputs, 1) for width in WIDTHS)
        self.apply(spread)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        stages = [self.stem(images)]
        for down in self.down:
            stages.append(down(stages[-1]))
        decode = self.anchored if self.version == 5 else self.distributed
        found = [
            decode(head(stage), stride, number)
            for number, (head, stage, stride) in enumerate(zip(self.heads, stages, STRIDES, strict=True))
        ]
        detections = torch.cat(found, 1)
        return (detections if self.version == 5 else detections.transpose(1, 2)), self.prototypes(stages[0])

    def anchored(self, values: torch.Tensor, stride: int, number: int) -> torch.Tensor:
        height, width = values.shape[2:]
        values = values.view(1, 3, -1, height, width).permute(0, 1, 3, 4, 2)
        centre = (2 * values[..., :2].sigmoid() - 0.5 + cells(height, width, 0)) * stride
        size = (2 * values[..., 2:4].sigmoid()) ** 2 * torch.tensor(ANCHORS[number]).view(3, 1, 1, 2)
        scores = (values[..., 4 : 5 + CLASSES] + self.bias).sigmoid()
        return torch.cat([centre, size, scores, values[..., 5 + CLASSES :]], -1).reshape(1, 3 * height * width, -1)

    def distributed(self, values: torch.Tensor, stride: int, number: int) -> torch.Tensor:
        height, width = values.shape[2:]
        values = values.permute(0, 2, 3, 1).reshape(1, height * width, -1)
        bins = values[..., : 4 * BINS].reshape(1, -1, 4, BINS).softmax(-1) @ torch.arange(BINS, dtype=torch.float)
        middle = cells(height, width, 0.5).reshape(-1, 2)
        upper, lower = middle - bins[..., :2], middle + bins[..., 2:]
        scores = (values[..., 4 * BINS : 4 * BINS + CLASSES] + self.bias).sigmoid()
        boxes = torch.cat([(upper + lower) / 2, lower - upper], -1) * stride
        return torch.cat([boxes, scores, values[..., 4 * BINS + CLASSES :]], -1)


def cells(height: int, width: int, shift: float) -> torch.Tensor:
    """[height, width, 2]: x and y of each cell."""
    y, x = torch.meshgrid(torch.arange(height) + shift, torch.arange(width) + shift, indexing="ij")
    return torch.stack([x, y], -1)


# --- SAM -------------------------------------------------------------------------------------------------------------

DEPTH, TOKENS, EMBEDDING, WINDOW = 192, 64, 256, 16


class Attention(nn.Module):
    """Of queries to keys and values, [b, n, d] each; inside in `inner` dimensions."""

    def __init__(self, width: int, heads: int, inner: int | None = None) -> None:
        super().__init__()
        self.heads, inner = heads, inner or width
        self.query, self.key, self.value = (nn.Linear(width, inner) for _ in range(3))
        self.out = nn.Linear(inner, width)

    def forward(self, query: torch.Tensor, key: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
        def split(x: torch.Tensor) -> torch.Tensor:
            return x.view(x.shape[0], x.shape[1], self.heads, -1).transpose(1, 2)

        q, k, v = split(self.query(query)), split(self.key(key)), split(self.value(value))
        weights = (q @ k.transpose(2, 3) / math.sqrt(q.shape[-1])).softmax(-1)
        return self.out((weights @ v).transpose(1, 2).flatten(2))


class RandomEncoder(nn.Module):
    """A small vision transformer: patches of 16 px, attention in windows and once over all, [1, 256, 64, 64]."""

    def __init__(self) -> None:
        super().__init__()
        self.patches = nn.Conv2d(3, DEPTH, 16, 16)
        self.position = nn.Parameter(0.02 * torch.randn(1, TOKENS, TOKENS, DEPTH))
        self.attention = nn.ModuleList(Attention(DEPTH, 3) for _ in range(2))
        self.mlp = nn.ModuleList(nn.Sequential(nn.LayerNorm(DEPTH), mlp(DEPTH, 4 * DEPTH)) for _ in range(2))
        self.neck = nn.Sequential(nn.Conv2d(DEPTH, EMBEDDING, 1), nn.Conv2d(EMBEDDING, EMBEDDING, 3, 1, 1))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        x = self.patches(image).permute(0, 2, 3, 1) + self.position
        side = TOKENS // WINDOW
        x = x.view(side, WINDOW, side, WINDOW, DEPTH).transpose(1, 2).reshape(side * side, WINDOW * WINDOW, DEPTH)
        x = x + self.attention[0](x, x, x)
        x = x + self.mlp[0](x)
        x = x.view(side, side, WINDOW, WINDOW, DEPTH).transpose(1, 2).reshape(1, TOKENS * TOKENS, DEPTH)
        x = x + self.attention[1](x, x, x)
        x = x + self.mlp[1](x)
        return self.neck(x.view(1, TOKENS, TOKENS, DEPTH).permute(0, 3, 1, 2))


def mlp(width: int, inner: int, outputs: int | None = None) -> nn.Module:
    return nn.Sequential(nn.Linear(width, inner), nn.GELU(), nn.Linear(inner, outputs or width))


class TwoWay(nn.Module):
    """Tokens look at themselves and at the image, and the image at them."""

    def __init__(self) -> None:
        super().__init__()
        self.own = Attention(EMBEDDING, 8)
        self.to_image, self.to_tokens = Attention(EMBEDDING, 8, 128), Attention(EMBEDDING, 8, 128)
        self.mlp = mlp(EMBEDDING, 2048)
        self.norms = nn.ModuleList(nn.LayerNorm(EMBEDDING) for _ in range(4))

    def forward(
        self, tokens: torch.Tensor, image: torch.Tensor, first: torch.Tensor, position: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        tokens = self.norms[0](tokens + self.own(tokens, tokens, tokens))
        tokens = self.norms[1](tokens + self.to_image(tokens + first, image + position, image))
        tokens = self.norms[2](tokens + self.mlp(tokens))
        return tokens, self.norms[3](image + self.to_tokens(image + position, tokens + first, tokens))


class RandomDecoder(nn.Module):
    """In Meta's layout and of its size: prompts embedded by random frequencies, two layers of attention in both
    directions, four masks of 256 x 256 px by small networks of the tokens.

    Args:
        bias: added to scores.
    """

    def __init__(self, bias: float = 0) -> None:
        super().__init__()
        self.bias = bias
        self.frequencies = nn.Parameter(torch.randn(2, EMBEDDING // 2))
        self.labels = nn.Embedding(3, EMBEDDING)  # of no point, of one outside and of one inside
        self.tokens = nn.Parameter(torch.randn(1, 5, EMBEDDING))
        self.no_hint = nn.Parameter(torch.randn(1, EMBEDDING, 1, 1))
        self.hint = nn.Conv2d(1, EMBEDDING, 4, 4)
        self.layers = nn.ModuleList(TwoWay() for _ in range(2))
        self.last = Attention(EMBEDDING, 8, 128)
        self.enlarge = nn.Sequential(
            nn.ConvTranspose2d(EMBEDDING, 64, 2, 2), nn.GELU(), nn.ConvTranspose2d(64, 32, 2, 2), nn.GELU()
        )
        self.weights = nn.ModuleList(mlp(EMBEDDING, EMBEDDING, 32) for _ in range(4))
        self.quality = mlp(EMBEDDING, EMBEDDING, 4)
        self.apply(spread)

    def embed(self, places: torch.Tensor) -> torch.Tensor:
        """[..., 256] of x and y from 0 to 1."""
        angles = 2 * math.pi * ((2 * places - 1) @ self.frequencies)
        return torch.cat([angles.sin(), angles.cos()], -1)

    def forward(
        self, embeddings: torch.Tensor, points: torch.Tensor, labels: torch.Tensor, hint: torch.Tensor,
        has_hint: torch.Tensor, size: torch.Tensor,
    ) -> Any:  # fmt: skip
        is_point = (labels >= 0)[..., None]
        prompts = self.embed((points + 0.5) / 1024) * is_point + self.labels((labels + 1).long())
        first = torch.cat([self.tokens, prompts], 1)
        image = embeddings + has_hint * self.hint(hint) + (1 - has_hint) * self.no_hint
        image = image.flatten(2).transpose(1, 2)
        position = self.embed(cells(TOKENS, TOKENS, 0.5) / TOKENS).view(1, TOKENS * TOKENS, EMBEDDING)
        tokens = first
        for layer in self.layers:
            tokens, image = layer(tokens, image, first, position)
        tokens = tokens + self.last(tokens + first, image + position, image)
        large = self.enlarge(image.transpose(1, 2).reshape(1, EMBEDDING, TOKENS, TOKENS))
        weights = torch.stack([net(tokens[:, 1 + i]) for i, net in enumerate(self.weights)], 1)
        small = (weights @ large.flatten(2)).view(1, 4, 4 * TOKENS, 4 * TOKENS)
        masks = functional.interpolate(small, (1024, 1024), mode="bilinear")
        inner = torch.floor(1024 / size.max() * size + 0.5).long()
        masks, size = masks[..., : inner[0], : inner[1]], size.long()
        masks = functional.interpolate(masks, (size[0], size[1]), mode="bilinear")
        return masks, self.quality(tokens[:, 0]) + self.bias, small
