# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scripts that give a browser a graphics card as some are."""

# As in a telephone: it takes no more than 256 columns.
SMALL_CARD = """() => {
    const card = WebGL2RenderingContext.prototype, {getParameter, texImage2D, getError} = card;
    let error = 0;
    card.getParameter = function (name) {
        return name === card.MAX_TEXTURE_SIZE ? 256 : getParameter.call(this, name);
    };
    card.texImage2D = function (...all) {
        const image = all.at(-1), width = all.length > 6 ? all[3] : image.width;
        if (width > 256) error = card.INVALID_VALUE;
        else texImage2D.apply(this, all);
    };
    card.getError = function () {
        const found = error || getError.call(this);
        error = 0;
        return found;
    };
}"""
NO_CARD = """() => {
    const {getContext} = HTMLCanvasElement.prototype;
    HTMLCanvasElement.prototype.getContext = function (kind, ...all) {
        return kind.startsWith('webgl') ? null : getContext.call(this, kind, ...all);
    };
}"""
# It has none left once pictures come.
NO_MEMORY = """() => {
    let uploads = 0;
    const card = WebGL2RenderingContext.prototype;
    card.texImage2D = () => { uploads++; };
    card.getError = () => uploads ? card.OUT_OF_MEMORY : 0;
}"""
# It draws nothing and calls that no error.
BLIND = '() => { WebGL2RenderingContext.prototype.drawArraysInstanced = () => {}; }'
