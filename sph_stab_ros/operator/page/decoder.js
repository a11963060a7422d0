// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Files of pictures into what WebGL takes.

const JPEG = 'image/jpeg', PNG = 'image/png', PNG_STARTS_WITH = 0x89;
const MAX_MADE_PLANAR = 2048;
// By how much chroma is reduced, in columns and rows.
const CHROMA = {I420: [2, 2], I422: [2, 1], I444: [1, 1]};

// Returns an ImageBitmap, or {width, height, planes, close}: luma and the two of chroma as the file
// has them, each {data, width, height, stride}. These take half the time to decode and a tenth to
// hand over (9 ms and 1 ms at 1920 columns, without a graphics card), but not in every browser.
// Whoever has it closes it once, as an ImageBitmap. A picture of more than maxColumns, which a
// graphics card may not take, comes as an ImageBitmap of fewer.
export async function decode(file, maxColumns = Infinity) {
  const type = file[0] === PNG_STARTS_WITH ? PNG : JPEG;
  return (type === JPEG && await planesOf(file, maxColumns).catch(() => null))
    || reduced(await createImageBitmap(new Blob([file], {type})), maxColumns);
}

// Takes over an ImageBitmap; a VideoFrame is left to whoever has it.
async function reduced(image, maxColumns) {
  const width = image.displayWidth ?? image.width, height = image.displayHeight ?? image.height;
  if (width <= maxColumns) return image;
  try {
    return await createImageBitmap(image, {
      resizeWidth: maxColumns, resizeHeight: Math.round(maxColumns * height / width),
      resizeQuality: 'medium',
    });
  } finally {
    if (image instanceof ImageBitmap) image.close();
  }
}

async function planesOf(file, maxColumns) {
  if (!globalThis.ImageDecoder) return null;
  const decoder = new ImageDecoder({data: file, type: JPEG, colorSpaceConversion: 'none'});
  try {
    return await imageOf((await decoder.decode()).image, maxColumns);
  } finally {
    decoder.close();
  }
}

// Takes over a VideoFrame; returns what ``decode`` does. A card's own may have no planes to copy.
export async function imageOf(frame, maxColumns) {
  try {
    if (frame.displayWidth > maxColumns) return await reduced(frame, maxColumns);
    return frame.format in CHROMA ? await copied(frame) : await createImageBitmap(frame);
  } finally {
    frame.close();
  }
}

// Of limited range, which a camera's video often has, into full, which JPEG has.
const LUMA = Uint8ClampedArray.from({length: 256}, (_, value) => (value - 16) * 255 / 219);
const COLOUR = Uint8ClampedArray.from({length: 256}, (_, value) => 128 + (value - 128) * 255 / 224);

function stretch({data}, index) {
  const levels = index ? COLOUR : LUMA;
  for (let n = 0; n < data.length; n++) data[n] = levels[data[n]];
}

// Of pictures that were closed; fresh memory for each takes longer than to copy it.
const spare = [];

async function copied(image) {
  const {visibleRect: {width, height}, format} = image;
  const size = image.allocationSize();
  let buffer = spare.pop();
  if (buffer?.length !== size) buffer = new Uint8Array(size);
  const layout = await image.copyTo(buffer);
  const planes = layout.map(({offset, stride}, i) => ({
    data: buffer.subarray(offset, layout[i + 1]?.offset), stride,
    width: i ? Math.ceil(width / CHROMA[format][0]) : width,
    height: i ? Math.ceil(height / CHROMA[format][1]) : height,
  }));
  if (image.colorSpace.fullRange === false) planes.forEach(stretch);
  return {width, height, planes, close: () => spare.push(buffer)};
}

// Returns an image of ``decode`` as planes, whichever it is, and takes it over. One that has to be
// made planar, pixel by pixel, has no more of them than a view shows.
export function planar(image) {
  if (image.planes) return image;
  const width = Math.min(image.width, MAX_MADE_PLANAR);
  const height = Math.round(width * image.height / image.width);
  const context = new OffscreenCanvas(width, height).getContext('2d');
  context.drawImage(image, 0, 0, width, height);
  image.close();
  const rgba = context.getImageData(0, 0, width, height).data;
  const planes = Array.from({length: 3}, () => (
    {data: new Uint8ClampedArray(width * height), stride: width, width, height}));
  const [y, cb, cr] = planes.map(plane => plane.data);
  for (let n = 0; n < y.length; n++) {
    const r = rgba[4 * n], g = rgba[4 * n + 1], b = rgba[4 * n + 2];
    y[n] = 0.299 * r + 0.587 * g + 0.114 * b;
    cb[n] = 128 + (b - y[n]) / 1.772;
    cr[n] = 128 + (r - y[n]) / 1.402;
  }
  return {width, height, planes, close() {}};
}
