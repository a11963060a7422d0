// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// What every user of WebGL needs.

// Returns the program of two shaders; throws an Error where the browser cannot make it.
export function programOf(gl, vertexShader, fragmentShader) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertexShader],
                                [gl.FRAGMENT_SHADER, fragmentShader]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    throw new Error(`WebGL: ${gl.getProgramInfoLog(program) ?? 'no program'}`);
  }
  return program;
}
