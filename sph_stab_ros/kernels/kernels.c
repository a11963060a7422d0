// Copyright 2026 The sph_stab_ros developers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

// The inner loops of the anchored tracker, the warp and the colours of videos. Arrays are dense, in
// C order; the Python functions that call these say what they mean, and do the same in NumPy where
// nothing was compiled.

#include <math.h>
#include <stdint.h>
#include <string.h>
#ifdef __x86_64__
#include <immintrin.h>
#endif

#define PI 3.14159265358979323846
// As in patches.py.
#define SAMPLES 11
#define PIXELS (SAMPLES * SAMPLES)
// Of a line of the cache.
#define LINE_FLOATS 16

#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && __GNUC__ >= 12
// By what a processor can, whoever made it: "arch=haswell" would be Intel's alone.
#define WITH_WIDE_VECTORS __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define WITH_WIDE_VECTORS
#endif
#if defined(__GNUC__)
// Not only a wish: what is called must become part of each clone.
#define INLINE static inline __attribute__((always_inline))
#define FETCH(address) __builtin_prefetch(address)
#else
#define INLINE static inline
#define FETCH(address)
#endif

// Within 1e-7, by a polynomial that compilers make vectors of (Abramowitz and Stegun 4.4.49).
INLINE float arctan2(float y, float x) {
  const float longer = fmaxf(fabsf(x), fabsf(y)), shorter = fminf(fabsf(x), fabsf(y));
  const float t = shorter / fmaxf(longer, 1e-30f), s = t * t;
  float angle = t + t * s * (-0.3333314528f + s * (0.1999355085f + s * (-0.1420889944f
                + s * (0.1065626393f + s * (-0.0752896400f + s * (0.0429096138f
                + s * (-0.0161657367f + s * 0.0028662257f)))))));
  angle = fabsf(y) > fabsf(x) ? (float)(PI / 2) - angle : angle;
  angle = x < 0 ? (float)PI - angle : angle;
  return copysignf(angle, y);
}

// Equirect.pixels of n bearings, in a picture so wide.
INLINE void pixels_of(int n, const float *x, const float *y, const float *z, int width, float *u,
                      float *v) {
  const float rad_to_px = width / (2 * PI), u_middle = width / 2. - 0.5,
              v_middle = width / 4. - 0.5, v_last = width / 2. - 1;
  for (int i = 0; i < n; i++) {
    u[i] = arctan2(x[i], z[i]) * rad_to_px + u_middle;
    const float below = arctan2(y[i], sqrtf(x[i] * x[i] + z[i] * z[i])) * rad_to_px + v_middle;
    v[i] = fminf(fmaxf(below, 0), v_last);
  }
}

WITH_WIDE_VECTORS
void equirect_pixels(int n, const float *x, const float *y, const float *z, int width, float *u,
                     float *v) {
  pixels_of(n, x, y, z, width, u, v);
}

// Columns of a plane that are doubled at a time.
#define SPAN 512

// A plane (height, width) twice as high and wide, bilinearly: the colours of a video for each of
// its pixels.
WITH_WIDE_VECTORS
void doubled(int height, int width, const uint8_t *restrict plane, uint8_t *restrict out) {
  // Of each column, and of those next to the first and the last one, between two rows.
  uint16_t between[SPAN + 2];
  for (int row = 0; row < 2 * height; row++)
    for (int first = 0; first < width; first += SPAN) {
      const int n = width - first < SPAN ? width - first : SPAN;
      const int other = row / 2 + (row % 2 ? 1 : -1);
      const uint8_t *near = plane + (int64_t)(row / 2) * width + first;
      const uint8_t *far = other < 0 || other == height ? near : near + (other - row / 2) * width;
      for (int k = 0; k < n; k++) between[k + 1] = 3 * near[k] + far[k];
      between[0] = first ? 3 * near[-1] + far[-1] : between[1];
      between[n + 1] = first + n < width ? 3 * near[n] + far[n] : between[n];
      uint8_t *values = out + ((int64_t)row * width + first) * 2;
      for (int k = 0; k < n; k++) {
        values[2 * k] = (uint16_t)(3 * between[k + 1] + between[k] + 8) >> 4;
        values[2 * k + 1] = (uint16_t)(3 * between[k + 1] + between[k + 2] + 8) >> 4;
      }
    }
}

// Parts of the warp's target that stay in the fastest cache with what they are read from.
#define TILE_CELLS 16
#define TILE_ROWS 48
#define MAX_CELL 8
#define TILE_WIDTH (TILE_CELLS * MAX_CELL)
// How many rows of cells ahead the picture is fetched.
#define CELLS_AHEAD 2

// Values at a row's pixels within n cells, from those at the nodes above and below. Of each cell
// MAX_CELL are written, a whole vector: the next cell's go over what is too much.
INLINE void between_nodes(int n, int cell, const float *restrict above,
                          const float *restrict below, float down, const float *restrict along,
                          float *restrict values) {
  float nodes[TILE_CELLS + 1];
  for (int c = 0; c <= n; c++) nodes[c] = above[c] + down * (below[c] - above[c]);
  for (int c = 0; c < n; c++, values += cell) {
    const float first = nodes[c], step = nodes[c + 1] - first;
    for (int j = 0; j < MAX_CELL; j++) values[j] = first + along[j] * step;
  }
}

// Steps of a pixel, as cv2.remap has them: by less, a map that is interpolated is not exact, and a
// picture that is not turned stays as it is. Weights of neighbouring pixels add up to this.
#define STEPS 32
#define VALUE_BITS 10
#define HALF (1 << (VALUE_BITS - 1))

// What to read for a pixel: the one left above, and how many STEPS fall to those right and below.
struct place {
  int left, top, right, below;
};

INLINE struct place place_of(float u, float v, int height, int width) {
  const int across = (int)((fminf(fmaxf(u, -1), width - 0.5f) + 1) * STEPS + 0.5f);
  const int down = (int)(fminf(fmaxf(v, 0), height - 1) * STEPS + 0.5f);
  const int top = down / STEPS < height - 2 ? down / STEPS : height - 2;
  return (struct place){across / STEPS - 1, top, across % STEPS, down - top * STEPS};
}

// Whether a pixel lies beyond the seam, or too near to read more than there is of a row.
INLINE int is_at_seam(int left, int width) { return (left < 0) | (left > width - 3); }

#define MAX_CHANNELS 4
// Of a tile, and a vector's end behind it.
#define ROW_BYTES (MAX_CHANNELS * TILE_WIDTH + 4)
// So many are read at a time, at most: behind the last place there are as many that can be read.
#define AT_A_TIME 8

// Up to TILE_WIDTH places, by how far they are from the image's first byte.
struct reads {
  int at[TILE_WIDTH], right[TILE_WIDTH], below[TILE_WIDTH];
};

// Returns whether some are at the seam; what stands for those may be read, but means nothing.
INLINE int plan(int n, const float *u, const float *v, int height, int width, int channels,
                struct reads *reads) {
  int at_seam = 0;
  for (int k = 0; k < n; k++) {
    const struct place place = place_of(u[k], v[k], height, width);
    const int seam = is_at_seam(place.left, width);
    at_seam |= seam;
    reads->at[k] = (place.top * width + (seam ? 0 : place.left)) * channels;
    reads->right[k] = place.right;
    reads->below[k] = place.below;
  }
  for (int k = n; k % AT_A_TIME; k++) reads->at[k] = reads->right[k] = reads->below[k] = 0;
  return at_seam;
}

INLINE int between_pixels(int left_above, int right_above, int left_below, int right_below,
                          int right, int below) {
  const int upper = left_above * STEPS + right * (right_above - left_above);
  const int lower = left_below * STEPS + right * (right_below - left_below);
  return (upper * STEPS + below * (lower - upper) + HALF) >> VALUE_BITS;
}

// Read a pixel bilinearly; the sphere goes on beyond the seam.
INLINE void read_place(struct place place, const uint8_t *image, int width, int channels,
                       uint8_t *out) {
  const uint8_t *above = image + (int64_t)place.top * width * channels;
  const uint8_t *below = above + width * channels;
  const int left = (place.left < 0 ? width - 1 : place.left) * channels;
  const int right = (place.left > width - 2 ? 0 : place.left + 1) * channels;
  for (int c = 0; c < channels; c++)
    out[c] = between_pixels(above[left + c], above[right + c], below[left + c], below[right + c],
                            place.right, place.below);
}

// The same of n places not at the seam. Two loops, because compilers make vectors of the second one
// only; what is copied beyond a pixel the next one goes over.
INLINE void read_places(int n, int channels, const struct reads *reads, const uint8_t *image,
                        int width, uint8_t *out) {
  uint8_t corners[4][ROW_BYTES], right[ROW_BYTES], below[ROW_BYTES];
  const int copied = channels == 3 ? 4 : channels;
  for (int k = 0, i = 0; k < n; k++, i += channels) {
    const uint8_t *above = image + reads->at[k], *under = above + width * channels;
    memcpy(corners[0] + i, above, copied);
    memcpy(corners[1] + i, above + channels, copied);
    memcpy(corners[2] + i, under, copied);
    memcpy(corners[3] + i, under + channels, copied);
    memset(right + i, reads->right[k], copied);
    memset(below + i, reads->below[k], copied);
  }
  for (int i = 0; i < n * channels; i++)
    out[i] = between_pixels(corners[0][i], corners[1][i], corners[2][i], corners[3][i], right[i],
                            below[i]);
}

#ifdef __x86_64__
INLINE int64_t eight_bytes(const uint8_t *from) {
  int64_t bytes;
  memcpy(&bytes, from, 8);
  return bytes;
}

// Two pixels as numbers, blue, green, red and none, of 8 bytes of the row above and of that below;
// weights of the rows are bytes, those of columns words.
__attribute__((target("avx2")))
INLINE __m256i two_pixels(const uint8_t *one, const uint8_t *other, int row, __m256i down,
                          __m256i across) {
  // Above and below, then left and right, stand beside each other.
  const __m256i pairs = _mm256_broadcastsi128_si256(
      _mm_setr_epi8(0, 8, 3, 11, 1, 9, 4, 12, 2, 10, 5, 13, -1, -1, -1, -1));
  const __m256i bytes = _mm256_set_epi64x(eight_bytes(other + row), eight_bytes(other),
                                          eight_bytes(one + row), eight_bytes(one));
  const __m256i rows = _mm256_maddubs_epi16(_mm256_shuffle_epi8(bytes, pairs), down);
  return _mm256_srli_epi32(
      _mm256_add_epi32(_mm256_madd_epi16(rows, across), _mm256_set1_epi32(HALF)), VALUE_BITS);
}

// read_places of three channels, AT_A_TIME; up to four bytes more than those are written.
__attribute__((target("avx2")))
static void read_colours(int n, const struct reads *reads, const uint8_t *image, int width,
                         uint8_t *out) {
  const __m256i dense = _mm256_broadcastsi128_si256(
      _mm_setr_epi8(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -1, -1, -1, -1));
  const __m256i whole = _mm256_set1_epi32(STEPS);
  for (int k = 0; k < n; k += AT_A_TIME) {
    const int *at = reads->at + k;
    const __m256i right = _mm256_loadu_si256((const __m256i *)(reads->right + k));
    const __m256i below = _mm256_loadu_si256((const __m256i *)(reads->below + k));
    const __m256i across = _mm256_or_si256(_mm256_sub_epi32(whole, right),
                                           _mm256_slli_epi32(right, 16));
    const __m256i once = _mm256_or_si256(_mm256_sub_epi32(whole, below),
                                         _mm256_slli_epi32(below, 8));
    const __m256i down = _mm256_or_si256(once, _mm256_slli_epi32(once, 16));
    // Pixels j and j + 4: what follows goes by halves.
#define PIXELS_AT(j) \
    two_pixels(image + at[j], image + at[j + 4], 3 * width, \
               _mm256_shuffle_epi32(down, j * 0x55), _mm256_shuffle_epi32(across, j * 0x55))
    const __m256i values = _mm256_shuffle_epi8(
        _mm256_packus_epi16(_mm256_packs_epi32(PIXELS_AT(0), PIXELS_AT(1)),
                            _mm256_packs_epi32(PIXELS_AT(2), PIXELS_AT(3))), dense);
#undef PIXELS_AT
    _mm_storeu_si128((__m128i *)(out + 3 * k), _mm256_castsi256_si128(values));
    _mm_storeu_si128((__m128i *)(out + 3 * k + 12), _mm256_extracti128_si256(values, 1));
  }
}
#endif

// Read a row of n pixels, at most of a tile's.
INLINE void read_row(int n, const float *u, const float *v, const uint8_t *image, int height,
                     int width, int channels, uint8_t *out) {
  struct reads reads;
  const int at_seam = plan(n, u, v, height, width, channels, &reads);
#ifdef __x86_64__
  if (channels == 3 && __builtin_cpu_supports("avx2")) {
    uint8_t values[ROW_BYTES];
    read_colours(n, &reads, image, width, values);
    memcpy(out, values, 3 * n);
  } else
#endif
  // Quicker where the compiler knows how many there are.
  if (channels == 3)
    read_places(n, 3, &reads, image, width, out);
  else if (channels == 1)
    read_places(n, 1, &reads, image, width, out);
  else
    read_places(n, channels, &reads, image, width, out);
  for (int k = 0; at_seam && k < n; k++) {
    const struct place place = place_of(u[k], v[k], height, width);
    if (is_at_seam(place.left, width))
      read_place(place, image, width, channels, out + k * channels);
  }
}

// Fetch what n cells are read from: the picture turns, and no processor foresees the next row.
INLINE void fetch(int n, const float *u, const float *v, float down, int below,
                  const uint8_t *image, int width, int channels) {
  for (int c = 0; c <= n; c++) {
    const int column = u[c] + down * (u[c + below] - u[c]);
    const int line = v[c] + down * (v[c + below] - v[c]);
    FETCH(image + ((int64_t)line * width + column) * channels);
  }
}

// InverseWarp's target (target_height, target_width, channels) of cells (rows, columns), read from
// an equirectangular image. Pixels between nodes (rows + 1, columns + 1) are read between the
// nodes' pixels u, v or, in cells that are uneven, along the bearings between theirs.
WITH_WIDE_VECTORS
void warp_equirect(int columns, int cell, const float *u, const float *v, const uint8_t *uneven,
                   const float *x, const float *y, const float *z, int height, int width,
                   int channels, const uint8_t *image, int target_height, int target_width,
                   uint8_t *target) {
  const float *bearings[3] = {x, y, z};
  float along[MAX_CELL];
  for (int j = 0; j < MAX_CELL; j++) along[j] = (j + 0.5f) / cell;
  for (int tile = 0; tile < target_height; tile += TILE_ROWS)
    for (int first = 0; first < columns; first += TILE_CELLS) {
      const int cells = columns - first < TILE_CELLS ? columns - first : TILE_CELLS;
      const int pixels = cells * cell < target_width - first * cell
                             ? cells * cell : target_width - first * cell;
      const int end = tile + TILE_ROWS < target_height ? tile + TILE_ROWS : target_height;
      for (int row = tile; row < end; row++) {
        const int above = row / cell * (columns + 1) + first, below = above + columns + 1;
        const float down = along[row % cell];
        const int ahead = above + CELLS_AHEAD * (columns + 1);
        if (row + CELLS_AHEAD * cell < target_height)
          fetch(cells, u + ahead, v + ahead, down, columns + 1, image, width, channels);
        float u_px[TILE_WIDTH + MAX_CELL], v_px[TILE_WIDTH + MAX_CELL];
        between_nodes(cells, cell, u + above, u + below, down, along, u_px);
        between_nodes(cells, cell, v + above, v + below, down, along, v_px);
        for (int c = 0; c < cells; c++) {
          if (!uneven[row / cell * columns + first + c]) continue;
          float b[3][MAX_CELL];
          for (int k = 0; k < 3; k++)
            between_nodes(1, cell, bearings[k] + above + c, bearings[k] + below + c, down, along,
                          b[k]);
          pixels_of(cell, b[0], b[1], b[2], width, u_px + c * cell, v_px + c * cell);
        }
        read_row(pixels, u_px, v_px, image, height, width, channels,
                 target + ((int64_t)row * target_width + first * cell) * channels);
      }
    }
}

INLINE double dot(const double a[3], const double b[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

INLINE void cross(const double a[3], const double b[3], double out[3]) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

INLINE void turn(const double R[9], const double x[3], double out[3]) {
  for (int i = 0; i < 3; i++) out[i] = dot(R + 3 * i, x);
}

INLINE void turn_back(const double R[9], const double x[3], double out[3]) {
  for (int i = 0; i < 3; i++) out[i] = R[i] * x[0] + R[3 + i] * x[1] + R[6 + i] * x[2];
}

// Longitude and latitude (downwards) around a unit bearing b to second order: coefficients of
// 1, e, s, e², es and s² along unit tangents east and south.
static void expand(const double b[3], const double *tangents[2], double lon[6], double lat[6]) {
  static const int pairs[3][2] = {{0, 0}, {0, 1}, {1, 1}};
  static const double shares[3] = {0.5, 1, 0.5};
  const double x = b[0], y = b[1], z = b[2], rho = fmax(hypot(x, z), 1e-2);
  // Derivatives of rho, and rho² times those of longitude.
  double out[2], around[2];
  lon[0] = atan2(x, z);
  lat[0] = atan2(y, rho);
  for (int i = 0; i < 2; i++) {
    const double *t = tangents[i];
    out[i] = (x * t[0] + z * t[2]) / rho;
    around[i] = z * t[0] - x * t[2];
    lon[1 + i] = around[i] / (rho * rho);
    lat[1 + i] = rho * t[1] - y * out[i];
  }
  for (int k = 0; k < 3; k++) {
    const int i = pairs[k][0], j = pairs[k][1];
    const double *a = tangents[i], *c = tangents[j];
    lon[3 + k] = shares[k] * ((c[2] * a[0] - c[0] * a[2]) / (rho * rho)
                              - 2 * around[i] * out[j] / (rho * rho * rho));
    const double bend = (a[0] * c[0] + a[2] * c[2] - out[i] * out[j]) / rho;
    lat[3 + k] = shares[k] * (out[j] * a[1] - c[1] * out[i] - y * bend);
  }
}

// Read an image bilinearly at up to PIXELS pixels, moved by du and dv; its edge goes on for ever.
// Several loops, because compilers make vectors of all but the one in the middle.
// Numbers are stored with their lowest byte first.
INLINE void read_some(int n, const uint8_t *image, int height, int width, const float *u,
                      const float *v, float du, float dv, float *grey) {
  int index[PIXELS];
  float right[PIXELS], down[PIXELS];
  uint32_t above[PIXELS], below[PIXELS];
  for (int k = 0; k < n; k++) {
    const float column = fminf(fmaxf(u[k] + du, 0), width - 1.001f);
    const float row = fminf(fmaxf(v[k] + dv, 0), height - 1.001f);
    const int left = (int)column, top = (int)row;
    right[k] = column - left;
    down[k] = row - top;
    index[k] = top * width + left;
  }
  for (int k = 0; k < n; k++) {
    const uint8_t *pixel = image + index[k];
    // Four bytes, of which two count: the last two below, which may be the picture's last ones.
    memcpy(above + k, pixel, 4);
    memcpy(below + k, pixel + width - 2, 4);
  }
  for (int k = 0; k < n; k++) {
    const int left_above = above[k] & 255, right_above = above[k] >> 8 & 255;
    const int left_below = below[k] >> 16 & 255, right_below = below[k] >> 24;
    const float upper = left_above + right[k] * (right_above - left_above);
    const float lower = left_below + right[k] * (right_below - left_below);
    grey[k] = upper + down[k] * (lower - upper);
  }
}

// Pyramid.read.
WITH_WIDE_VECTORS
void read_pixels(int n, const uint8_t *image, int height, int width, const float *u,
                 const float *v, float *grey) {
  for (int i = 0; i < n; i += PIXELS)
    read_some(n - i < PIXELS ? n - i : PIXELS, image, height, width, u + i, v + i, 0, 0, grey + i);
}

// Fetch what a patch is compared with.
INLINE void fetch_patch(int64_t patch, const float *templates, const float *solvers) {
  for (int k = 0; k < PIXELS; k += LINE_FLOATS) FETCH(templates + patch * PIXELS + k);
  for (int k = 0; k < 2 * PIXELS; k += LINE_FLOATS) FETCH(solvers + patch * 2 * PIXELS + k);
}

// One level of Patches.find. Templates (., levels, PIXELS), deviations (., levels) and solvers
// (., levels, 2, PIXELS) are those of all patches; rows (n) tells which.
WITH_WIDE_VECTORS
void settle_patches(
    int n, const int64_t *rows, const double *expected, const double *east, const double *south,
    const double *scale, const uint8_t *image, int height, int width, int margin_px,
    const float *templates, const float *deviations, const float *solvers, int level, int levels,
    float spacing_px, int iterations, float max_step_px, float settled_px, float min_contrast,
    double *offsets_rad, float *differences, float *lengths_px) {
  const double px_per_rad = (width - 2 * margin_px) / (2 * PI);
  for (int i = 0; i < n; i++) {
    const double *tangents[2] = {east + 3 * i, south + 3 * i};
    double b[3], lon[6], lat[6], *offset = offsets_rad + 2 * i;
    for (int j = 0; j < 3; j++)
      b[j] = expected[3 * i + j] + offset[0] * tangents[0][j] + offset[1] * tangents[1][j];
    const double length_b = sqrt(dot(b, b));
    for (int j = 0; j < 3; j++) b[j] /= length_b;
    expand(b, tangents, lon, lat);

    // Pixels of the samples, first where nothing has moved.
    float u[PIXELS], v[PIXELS], grey[PIXELS], u_terms[6], v_terms[6];
    for (int j = 0; j < 6; j++) {
      const int order = j == 0 ? 0 : j < 3 ? 1 : 2;
      const double steps = px_per_rad * pow(scale[i] * spacing_px / px_per_rad, order);
      u_terms[j] = lon[j] * steps;
      v_terms[j] = lat[j] * steps;
    }
    u_terms[0] += (width - 1) / 2.f;
    v_terms[0] += (height - 1) / 2.f;
    for (int row = 0, k = 0; row < SAMPLES; row++)
      for (int column = 0; column < SAMPLES; column++, k++) {
        const float e = column - SAMPLES / 2, s = row - SAMPLES / 2;
        u[k] = u_terms[0] + e * (u_terms[1] + e * u_terms[3] + s * u_terms[4])
               + s * (u_terms[2] + s * u_terms[5]);
        v[k] = v_terms[0] + e * (v_terms[1] + e * v_terms[3] + s * v_terms[4])
               + s * (v_terms[2] + s * v_terms[5]);
      }

    const int64_t patch = rows[i] * levels + level;
    const float *template = templates + patch * PIXELS, deviation = deviations[patch];
    const float *along_east = solvers + patch * 2 * PIXELS, *along_south = along_east + PIXELS;
    // While this one is aligned; there are too many to stay in the fastest cache.
    if (i + 1 < n) fetch_patch(rows[i + 1] * levels + level, templates, solvers);
    float moved_east = 0, moved_south = 0, difference = 0, length = 0;
    for (int iteration = 0; iteration < iterations; iteration++) {
      const float du = lon[1] * moved_east + lon[2] * moved_south;
      const float dv = lat[1] * moved_east + lat[2] * moved_south;
      float mean = 0, squares = 0;
      read_some(PIXELS, image, height, width, u, v, du, dv, grey);
      for (int k = 0; k < PIXELS; k++) mean += grey[k];
      mean /= PIXELS;
      for (int k = 0; k < PIXELS; k++) squares += (grey[k] - mean) * (grey[k] - mean);
      // Free of brightness and contrast.
      const float gain = deviation / fmaxf(sqrtf(squares / PIXELS), min_contrast);
      float step_east = 0, step_south = 0;
      difference = 0;
      for (int k = 0; k < PIXELS; k++) {
        const float unlike = (grey[k] - mean) * gain - template[k];
        difference += unlike * unlike;
        step_east += along_east[k] * unlike;
        step_south += along_south[k] * unlike;
      }
      length = scale[i] * sqrtf(step_east * step_east + step_south * step_south);
      const float bounded = scale[i] * fminf(1, max_step_px / fmaxf(length, 1e-6f));
      moved_east -= bounded * step_east;
      moved_south -= bounded * step_south;
      if (length < settled_px) break;
    }
    offset[0] += moved_east / px_per_rad;
    offset[1] += moved_south / px_per_rad;
    differences[i] = difference / PIXELS;
    lengths_px[i] = length;
  }
}

// The derivative of r = W b by z, with b = z / |z|: M = W (I − b bᵀ) / |z|. Returns r too.
INLINE void look(const double W[6], const double z[3], double r[2], double M[6]) {
  const double length = sqrt(dot(z, z)), b[3] = {z[0] / length, z[1] / length, z[2] / length};
  for (int k = 0; k < 2; k++) {
    r[k] = dot(W + 3 * k, b);
    for (int i = 0; i < 3; i++) M[3 * k + i] = (W[3 * k + i] - r[k] * b[i]) / length;
  }
}

// A point with inverse depth rho, seen first from the origin c: q = p − c, z = R (x − rho q).
INLINE void see(const double R[9], const double p[3], const double x[3], const double c[3],
                       double rho, double q[3], double z[3]) {
  double in_world[3];
  for (int j = 0; j < 3; j++) {
    q[j] = p[j] - c[j];
    in_world[j] = x[j] - rho * q[j];
  }
  turn(R, in_world, z);
}

// Its residuals: how far off y it is seen, in deviations along the tangents W.
INLINE void whitened(const double R[9], const double p[3], const double x[3], const double c[3],
                     double rho, const double y[3], const double W[6], double r[2]) {
  double q[3], z[3], off[3];
  see(R, p, x, c, rho, q, z);
  const double length = sqrt(dot(z, z));
  for (int j = 0; j < 3; j++) off[j] = z[j] / length - y[j];
  for (int k = 0; k < 2; k++) r[k] = dot(W + 3 * k, off);
}

// pose_estimation.residuals.
void pose_residuals(int n, const double *R, const double *p, const double *x,
                    const double *origins, const double *rho, const double *y,
                    const double *sqrt_information, double *r) {
  for (int i = 0; i < n; i++)
    whitened(R, p, x + 3 * i, origins + 3 * i, rho[i], y + 3 * i, sqrt_information + 6 * i,
             r + 2 * i);
}

// The rows of a point's residuals by the pose, and how they change with its inverse depth.
INLINE void pose_rows(const double R[9], const double p[3], const double x[3], const double c[3],
                      double rho, const double W[6], double J[2][6], double J_rho[2]) {
  double q[3], z[3], along_b[2], M[6];
  see(R, p, x, c, rho, q, z);
  look(W, z, along_b, M);
  for (int k = 0; k < 2; k++) {
    double along[3];
    cross(z, M + 3 * k, J[k]);
    turn_back(R, M + 3 * k, along);
    for (int j = 0; j < 3; j++) J[k][3 + j] = -rho * along[j];
    J_rho[k] = -dot(along, q);
  }
}

// The upper median of values, which it reorders (C. A. R. Hoare, Algorithm 65: find, 1961).
static double upper_median(int n, double *values) {
  const int middle = n / 2;
  int from = 0, to = n - 1;
  while (from < to) {
    const double pivot = values[middle];
    int i = from, j = to;
    while (i <= j) {
      // Within bounds whatever is no number.
      while (i < to && values[i] < pivot) i++;
      while (j > from && values[j] > pivot) j--;
      if (i > j) break;
      const double swapped = values[i];
      values[i++] = values[j];
      values[j--] = swapped;
    }
    if (j < middle) from = i;
    if (i > middle) to = j;
  }
  return values[middle];
}

// Solve H x = g for a symmetric positive definite H, by A.-L. Cholesky's decomposition.
static void solve(const double H[36], const double g[6], double x[6]) {
  double L[36];
  for (int i = 0; i < 6; i++) {
    for (int j = 0; j <= i; j++) {
      double sum = H[6 * i + j];
      for (int k = 0; k < j; k++) sum -= L[6 * i + k] * L[6 * j + k];
      L[6 * i + j] = i == j ? sqrt(fmax(sum, 1e-300)) : sum / L[7 * j];
    }
    x[i] = g[i];
    for (int k = 0; k < i; k++) x[i] -= L[6 * i + k] * x[k];
    x[i] /= L[7 * i];
  }
  for (int i = 5; i >= 0; i--) {
    for (int k = i + 1; k < 6; k++) x[i] -= L[6 * k + i] * x[k];
    x[i] /= L[7 * i];
  }
}

// Turn R by a rotation vector of the frame into which it leads (O. Rodrigues' formula).
static void turn_further(const double rotvec[3], double R[9]) {
  const double angle = sqrt(dot(rotvec, rotvec)), half = fmax(angle / 2, 1e-9);
  const double along = sin(2 * half) / (2 * half), back = sin(half) * sin(half) / (2 * half * half);
  for (int i = 0; i < 3; i++) {
    const double column[3] = {R[i], R[3 + i], R[6 + i]};
    double once[3], twice[3];
    cross(rotvec, column, once);
    cross(rotvec, once, twice);
    for (int j = 0; j < 3; j++) R[3 * j + i] += along * once[j] + back * twice[j];
  }
}

// pose_estimation._fit. R, p, rho and all that follows are written; of these the first is the
// start, and work (10 n) is nobody's.
WITH_WIDE_VECTORS
void fit_pose(int n, const double *x, const double *origins, const double *rho_0,
              const double *information, const double *y, const double *sqrt_information,
              const double *say, double position_sigma, int max_iterations, int min_iterations,
              double step_tolerance, double max_inverse_depth, double width, int power,
              double wide_start, double min_scale, double max_scale, double *R, double *p,
              double *rho, double *sizes, double *weights, double *scale, double *H,
              double *work) {
  const double median_1d = 0.6745, median_2d = 1.1774, p_0[3] = {p[0], p[1], p[2]};
  double *ratios = work, *H_rr = work + n, *g_r = work + 2 * n, *H_rp = work + 4 * n;
  for (int i = 0; i < n; i++) H_rr[i] = information[i];
  for (int iteration = 0; iteration < max_iterations; iteration++) {
    for (int i = 0; i < n; i++) {
      double r[2];
      whitened(R, p, x + 3 * i, origins + 3 * i, rho[i], y + 3 * i, sqrt_information + 6 * i, r);
      sizes[i] = sqrt(r[0] * r[0] + r[1] * r[1]);
      ratios[i] = sizes[i] / (median_1d + (median_2d - median_1d) * information[i] / H_rr[i]);
    }
    *scale = fmin(fmax(upper_median(n, ratios), min_scale), max_scale);
    const double half_at = width * *scale * fmax(1, wide_start / (1 << iteration));
    double g[6] = {0}, step[6], longest = 0;
    for (int k = 0; k < 36; k++) H[k] = 0;
    for (int i = 0; i < n; i++) {
      double r[2], J[2][6], J_rho[2], *to_depth = H_rp + 6 * i;
      const double off = sizes[i] / half_at, weight = 1 / (1 + off * off);
      weights[i] = power == 1 ? weight : pow(weight, power);
      const double w = say[i] * weights[i] / (*scale * *scale);
      whitened(R, p, x + 3 * i, origins + 3 * i, rho[i], y + 3 * i, sqrt_information + 6 * i, r);
      pose_rows(R, p, x + 3 * i, origins + 3 * i, rho[i], sqrt_information + 6 * i, J, J_rho);
      H_rr[i] = information[i] + w * (J_rho[0] * J_rho[0] + J_rho[1] * J_rho[1]);
      g_r[i] = information[i] * (rho[i] - rho_0[i]) + w * (J_rho[0] * r[0] + J_rho[1] * r[1]);
      for (int a = 0; a < 6; a++) to_depth[a] = w * (J_rho[0] * J[0][a] + J_rho[1] * J[1][a]);
      for (int a = 0; a < 6; a++) {
        const double first = w * J[0][a], second = w * J[1][a], by = to_depth[a] / H_rr[i];
        g[a] += first * r[0] + second * r[1] - by * g_r[i];
        for (int b = 0; b < 6; b++)
          H[6 * a + b] += first * J[0][b] + second * J[1][b] - by * to_depth[b];
      }
    }
    const double firmness = 1 / (position_sigma * position_sigma);
    for (int j = 0; j < 3; j++) {
      H[7 * (3 + j)] += firmness;
      g[3 + j] += firmness * (p[j] - p_0[j]);
    }
    solve(H, g, step);
    for (int j = 0; j < 6; j++) {
      step[j] = -step[j];
      longest = fmax(longest, fabs(step[j]));
    }
    for (int i = 0; i < n; i++) {
      double changed = g_r[i];
      for (int j = 0; j < 6; j++) changed += H_rp[6 * i + j] * step[j];
      rho[i] = fmin(fmax(rho[i] - changed / H_rr[i], 0), max_inverse_depth);
    }
    turn_further(step, R);
    for (int j = 0; j < 3; j++) p[j] += step[3 + j];
    if (iteration + 1 >= min_iterations && longest < step_tolerance) break;
  }
}

// pose_estimation.depths_at; rho is the start and becomes the fit.
WITH_WIDE_VECTORS
void fit_depths(int n, const double *x, const double *origins, const double *rho_0,
                const double *information, const double *y, const double *sqrt_information,
                int iterations, double max_inverse_depth, const double *R, const double *p,
                double *rho) {
  for (int i = 0; i < n; i++)
    for (int iteration = 0; iteration < iterations; iteration++) {
      double r[2], J[2][6], J_rho[2];
      whitened(R, p, x + 3 * i, origins + 3 * i, rho[i], y + 3 * i, sqrt_information + 6 * i, r);
      pose_rows(R, p, x + 3 * i, origins + 3 * i, rho[i], sqrt_information + 6 * i, J, J_rho);
      const double H = information[i] + J_rho[0] * J_rho[0] + J_rho[1] * J_rho[1];
      const double g = information[i] * (rho[i] - rho_0[i]) + J_rho[0] * r[0] + J_rho[1] * r[1];
      rho[i] = fmin(fmax(rho[i] - g / H, 0), max_inverse_depth);
    }
}

// What a observation of a point x with inverse depth rho, hosted by keyframe h, in keyframe k says.
INLINE void sight(const double *R_h, const double *p_h, const double *R_k,
                         const double *p_k, const double *x, double rho, const double *y,
                         const double *sqrt_information, double x_world[3], double q[3], double z[3],
                         double r[2], double M[6]) {
  double W[6];
  turn(R_h, x, x_world);
  for (int j = 0; j < 3; j++) {
    q[j] = p_k[j] - p_h[j];
    z[j] = x_world[j] - rho * q[j];
  }
  for (int k = 0; k < 2; k++) turn(R_k, sqrt_information + 3 * k, W + 3 * k);
  look(W, z, r, M);
  for (int k = 0; k < 2; k++) r[k] -= dot(sqrt_information + 3 * k, y);
}

// bundle_window.residuals.
void bundle_residuals(int observations, const int64_t *keyframe, const int64_t *host,
                      const int64_t *point, const double *R, const double *p, const double *x,
                      const double *rho, const double *y, const double *sqrt_information, double *r) {
  for (int m = 0; m < observations; m++) {
    const int64_t k = keyframe[m], h = host[m], i = point[m];
    double x_world[3], q[3], z[3], M[6];
    sight(R + 9 * h, p + 3 * h, R + 9 * k, p + 3 * k, x + 3 * i, rho[i], y + 3 * m,
          sqrt_information + 6 * m, x_world, q, z, r + 2 * m, M);
  }
}

// Add weight · aᵀ c to a block of H, for two rows of up to 6 columns.
INLINE void add_products(double *restrict block, int columns, int high, int wide,
                         const double a[2][6], const double c[2][6], double weight) {
  for (int j = 0; j < high; j++) {
    const double first = weight * a[0][j], second = weight * a[1][j];
    for (int l = 0; l < wide; l++) block[j * columns + l] += first * c[0][l] + second * c[1][l];
  }
}

// bundle_window.pose_and_point_equations; slots (keyframes) are the places of those that are
// free, −1 of others; from the column lenses on, if it is one, are those of the lenses. All sums
// start at zero.
WITH_WIDE_VECTORS
void bundle_equations(int observations, int columns, int lenses, const int64_t *keyframe,
                      const int64_t *host, const int64_t *point, const int64_t *slots,
                      const double *R, const double *p, const double *x, const double *rho,
                      const double *y, const double *sqrt_information, const double *weights,
                      double *restrict H, double *restrict g, double *restrict H_rp,
                      double *restrict H_rr, double *restrict g_r) {
  for (int m = 0; m < observations; m++) {
    const int64_t k = keyframe[m], h = host[m], i = point[m];
    const double weight = weights[m], *x_h = x + 3 * i, *y_k = y + 3 * m;
    double x_world[3], q[3], z[3], r[2], M[6], J[3][2][6], J_rho[2];
    sight(R + 9 * h, p + 3 * h, R + 9 * k, p + 3 * k, x_h, rho[i], y_k, sqrt_information + 6 * m,
          x_world, q, z, r, M);
    for (int row = 0; row < 2; row++) {
      const double *along = M + 3 * row;
      J_rho[row] = -dot(along, q);
      cross(along, z, J[0][row]);
      cross(x_world, along, J[1][row]);
      for (int j = 0; j < 3; j++) {
        J[0][row][3 + j] = -rho[i] * along[j];
        J[1][row][3 + j] = rho[i] * along[j];
      }
      if (lenses < 0) continue;
      double at_host[3], by_x[3], by_y[3];
      turn_back(R + 9 * h, along, at_host);
      cross(x_h, at_host, by_x);
      cross(y_k, sqrt_information + 6 * m + 3 * row, by_y);
      for (int j = 0; j < 3; j++)
        J[2][row][j] = (x_h[2] > 0 ? 0.5 : -0.5) * by_x[j] - (y_k[2] > 0 ? 0.5 : -0.5) * by_y[j];
    }
    H_rr[i] += weight * (J_rho[0] * J_rho[0] + J_rho[1] * J_rho[1]);
    g_r[i] += weight * (J_rho[0] * r[0] + J_rho[1] * r[1]);
    const int64_t places[3] = {6 * slots[k], 6 * slots[h], lenses};
    const int sizes[3] = {6, 6, 3};
    for (int a = 0; a < 3; a++) {
      if (places[a] < 0) continue;
      for (int j = 0; j < sizes[a]; j++) {
        g[places[a] + j] += weight * (J[a][0][j] * r[0] + J[a][1][j] * r[1]);
        H_rp[i * columns + places[a] + j] +=
            weight * (J[a][0][j] * J_rho[0] + J[a][1][j] * J_rho[1]);
      }
      // The other half of H is added at the end.
      for (int c = a; c < 3; c++)
        if (places[c] >= 0)
          add_products(H + places[a] * columns + places[c], columns, sizes[a], sizes[c], J[a],
                       J[c], c == a ? weight / 2 : weight);
    }
  }
  for (int i = 0; i < columns; i++)
    for (int j = 0; j <= i; j++)
      H[i * columns + j] = H[j * columns + i] += H[i * columns + j];
}
