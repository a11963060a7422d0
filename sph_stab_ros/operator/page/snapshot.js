// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The view as a file.

// Lets the browser save what is on a canvas, as a PNG with the picture's stamp in its name. To be
// called by whoever has just drawn it: WebGL forgets.
export function saveSnapshot(canvas, stamp_ns) {
  const name = `view_${stamp_ns.slice(0, -9) || '0'}.${stamp_ns.slice(-9).padStart(9, '0')}.png`;
  canvas.toBlob(blob => {
    const link = document.createElement('a');
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    // The download has begun by then.
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  });
  return name;
}
