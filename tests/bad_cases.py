"""Mistakes, one a line: the command and a word of the answer; {good} and {bad} are folders of files, {out} an empty one."""

CASES = """
sample {bad}/missing.safetensors {good}/clean.mrc -o {out}/n.mrc | does not exist
sample {bad}/empty.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/folder {good}/clean.mrc -o {out}/n.mrc | is a folder
sample {bad}/text.mrc {good}/clean.mrc -o {out}/n.mrc | not a noise-model file
sample {bad}/cut.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/huge.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/long.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/pickle.safetensors {good}/clean.mrc -o {out}/n.mrc | not a noise-model file
sample {bad}/torch.safetensors {good}/clean.mrc -o {out}/n.mrc | not a noise-model file
sample {bad}/other.safetensors {good}/clean.mrc -o {out}/n.mrc | not a noiseflow noise model
sample {bad}/future.safetensors {good}/clean.mrc -o {out}/n.mrc | update noiseflow
sample {bad}/unknown.safetensors {good}/clean.mrc -o {out}/n.mrc | unknown noise model
sample {bad}/system.safetensors {good}/clean.mrc -o {out}/n.mrc | unknown noise model
sample {bad}/arguments.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/list.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/deep.safetensors {good}/clean.mrc -o {out}/n.mrc | deep.safetensors
sample {bad}/wide.safetensors {good}/clean.mrc -o {out}/n.mrc | wide.safetensors
sample {bad}/broad.safetensors {good}/clean.mrc -o {out}/n.mrc | do not fit
sample {bad}/maps.safetensors {good}/clean.mrc -o {out}/n.mrc | a size of 60000
sample {bad}/bins.safetensors {good}/clean.mrc -o {out}/n.mrc | do not fit
sample {bad}/mismatch.safetensors {good}/clean.mrc -o {out}/n.mrc | do not fit
sample {bad}/spoilt.safetensors {good}/clean.mrc -o {out}/n.mrc | NaN
sample {good}/model.safetensors {bad}/missing.mrc -o {out}/n.mrc | does not exist
sample {good}/model.safetensors {bad}/empty.mrc -o {out}/n.mrc | is empty
sample {good}/model.safetensors {bad}/empty.tif -o {out}/n.mrc | is empty
sample {good}/model.safetensors {bad}/empty.npy -o {out}/n.mrc | is empty
sample {good}/model.safetensors {bad}/cut.mrc -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/stub.mrc -o {out}/n.mrc | 1024 bytes
sample {good}/model.safetensors {bad}/text.mrc -o {out}/n.mrc | not an MRC file
sample {good}/model.safetensors {bad}/garbage.mrc -o {out}/n.mrc | not an MRC file
sample {good}/model.safetensors {bad}/absurd.mrc -o {out}/n.mrc | claims 10000 x 10000 x 10000
sample {good}/model.safetensors {bad}/negative.mrc -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/zero.mrc -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/extended.mrc -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/complex.mrc -o {out}/n.mrc | complex
sample {good}/model.safetensors {bad}/mode99.mrc -o {out}/n.mrc | mode 99
sample {good}/model.safetensors {bad}/nan.npy -o {out}/n.mrc | first at (3, 4, 5)
sample {good}/model.safetensors {bad}/inf.npy -o {out}/n.mrc | first at (3, 4, 5)
sample {good}/model.safetensors {bad}/complex.npy -o {out}/n.mrc | complex128
sample {good}/model.safetensors {bad}/words.npy -o {out}/n.mrc | holds <U1
sample {good}/model.safetensors {bad}/objects.npy -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/pickle.npy -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/four.npy -o {out}/n.mrc | --channel
sample {good}/model.safetensors {bad}/nothing.npy -o {out}/n.mrc | no pixels
sample {good}/model.safetensors {bad}/absurd.npy -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/colour.tif -o {out}/n.mrc | colour
sample {good}/model.safetensors {bad}/cut.tif -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.tif -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/absurd.tif -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/image.jpeg -o {out}/n.mrc | compressed with loss
sample {good}/model.safetensors {bad}/text.dm3 -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.dm4 -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.emd -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.ser -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.emi -o {out}/n.mrc | .ser
sample {good}/model.safetensors {bad}/text.hspy -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.h5 -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.nxs -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/absurd.h5 -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/void.h5 -o {out}/n.mrc | no image
sample {good}/model.safetensors {bad}/twins.h5 -o {out}/n.mrc | FILE::NAME
sample {good}/model.safetensors {bad}/twins.h5::/c -o {out}/n.mrc | holds no '/c'
sample {good}/model.safetensors {good}/clean.mrc::/c -o {out}/n.mrc | remove ::/c
sample {good}/model.safetensors {bad}/void.zarr -o {out}/n.mrc | void.zarr
sample {good}/model.safetensors {bad}/folder -o {out}/n.mrc | without images
sample {good}/model.safetensors {bad}/uneven -o {out}/n.mrc | same size
sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.jpeg | name it
sample {good}/model.safetensors {good}/clean.mrc -o {out}/none/n.mrc | create the folder
sample {good}/model.safetensors {good}/clean.mrc -o {bad}/folder | name it
sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.mrc --device cuda | --device cpu
sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.mrc --device toaster | choose auto
evaluate {good}/model.safetensors --signal {good}/clean.mrc --observation {good}/small.mrc | must have one shape
evaluate {good}/model.safetensors --signal {good}/clean.mrc {good}/clean.mrc --observation {good}/clean.mrc | both of each
evaluate {good}/model.safetensors --signal {good}/clean.mrc --observation {good}/clean.mrc | hold equal pixels
evaluate {good}/model.safetensors --signal {bad}/nan2d.npy --observation {good}/clean.mrc | NaN
evaluate {good}/model.safetensors --signal {good}/clean.mrc --observation {bad}/cut.tif | cannot be read
evaluate {bad}/cut.safetensors --signal {good}/clean.mrc --observation {good}/clean.mrc | damaged
evaluate {good}/model.safetensors --signal {good}/clean.mrc --observation {good}/clean.mrc --device cuda | --device cpu
calibrate --short {bad}/missing.tif --long {good}/long.tif -o {out}/m.safetensors | does not exist
calibrate --short {good}/050ms.tif --long {bad}/cut.tif -o {out}/m.safetensors | cannot be read
calibrate --short {good}/050ms.tif --long {good}/050ms.tif -o {out}/m.safetensors | as both short and long exposure
calibrate --short {good}/050ms.tif --long {good}/clean.mrc -o {out}/m.safetensors | pixels
calibrate --short {good}/small.mrc --long {good}/small.mrc -o {out}/m.safetensors | as both short and long exposure
calibrate --short {bad}/saturated.tif --long {good}/long.tif -o {out}/m.safetensors | saturated
calibrate --short {bad}/colour.tif --long {good}/long.tif -o {out}/m.safetensors | colour
calibrate --short {bad}/flat2d.npy --long {good}/long.tif -o {out}/m.safetensors | flat
calibrate --short {bad}/nan2d.npy --long {good}/long.tif -o {out}/m.safetensors | pixels
calibrate --short {good}/050ms.tif -o {out}/m.safetensors | only one frame
calibrate --short {good}/050ms.tif --exposure-ratio 3 -o {out}/m.safetensors | requires --long
calibrate --short {good}/050ms.tif --long {good}/long.tif --exposure-ratio 0 -o {out}/m.safetensors | above 1
calibrate --short {good}/050ms.tif --long {good}/long.tif --exposure-ratio nan -o {out}/m.safetensors | above 1
calibrate --short {good}/050ms.tif --long {good}/long.tif --region 0:64 -o {out}/m.safetensors | y0:y1,x0:x1
calibrate --short {good}/050ms.tif --long {good}/long.tif --region 0:9999,0:64 -o {out}/m.safetensors | is not inside
calibrate --short {good}/050ms.tif --long {good}/long.tif --region 8:24,0:64 -o {out}/m.safetensors | --region 8:24,0:64 of
calibrate --short {good}/050ms.tif --long {good}/long.tif --kind magic -o {out}/m.safetensors | magic
calibrate --short {good}/050ms.tif --long {good}/long.tif -o {out}/m.pt | name it
calibrate --short {good}/050ms.tif --long {good}/long.tif --dark {good}/050ms.tif -o {out}/m.safetensors | only one frame
calibrate --short {good}/050ms.tif --long {good}/long.tif --report {bad}/empty.mrc -o {out}/m.safetensors | is a file
calibrate --short {good}/050ms.tif --long {good}/long.tif -o {out}/m.safetensors --device cuda | --device cpu
simulate {out}/s --size 0 | size
simulate {out}/s --size -3 | size
simulate {out}/s --size 200000 | smaller size
simulate {out}/s --tilts 0:10:0 | tilts
simulate {out}/s --tilts 0:10 | START:STOP:STEP
simulate {out}/s --tilts=0:1e12:1e-6 | 10000 tilts
simulate {out}/s --tilts a:b:c | START:STOP:STEP
simulate {out}/s --tilts=-6_0:60:2 | START:STOP:STEP
simulate {out}/s --tilts nan:10:1 | tilts
simulate {out}/s --phantom unicorn | unicorn
simulate {out}/s --noise {bad}/missing.safetensors | missing.safetensors
simulate {out}/s --noise {bad}/pickle.safetensors | not a noise-model file
simulate {out}/s --mode sem | linear
simulate {bad}/empty.mrc | empty.mrc
reconstruct {bad}/missing.mrc -o {out}/v.mrc | does not exist
reconstruct {bad}/empty.mrc -o {out}/v.mrc | is empty
reconstruct {bad}/cut.mrc -o {out}/v.mrc | header claims
reconstruct {bad}/absurd.mrc -o {out}/v.mrc | header claims
reconstruct {bad}/text.dm3 -o {out}/v.mrc | cannot be read
reconstruct {good}/clean.mrc -o {out}/v.mrc | one image
reconstruct {good}/alone.mrc -o {out}/v.mrc | no tilt angles
reconstruct {bad}/folder -o {out}/v.mrc | without images
reconstruct {bad}/nan.npy -o {out}/v.mrc | NaN
reconstruct {bad}/inf.npy -o {out}/v.mrc | infinite
reconstruct {bad}/flat.npy -o {out}/v.mrc | flat
reconstruct {good}/tilts.mrc --angles {bad}/missing.tlt -o {out}/v.mrc | does not exist
reconstruct {good}/tilts.mrc --angles {good} -o {out}/v.mrc | is no file
reconstruct {good}/tilts.mrc --angles {good}/clean.mrc -o {out}/v.mrc | is not a text file
reconstruct {good}/tilts.mrc -o {out}/v.mrc --method wbp-denoised --denoiser os:system | it failed on an image
reconstruct {good}/tilts.mrc -o {out}/v.mrc --method wbp-denoised --denoiser os:name | it failed on an image
reconstruct {good}/tilts.mrc --angles {bad}/empty.tlt -o {out}/v.mrc | no angles
reconstruct {good}/tilts.mrc --angles {bad}/blank.tlt -o {out}/v.mrc | no angles
reconstruct {good}/tilts.mrc --angles {bad}/words.tlt -o {out}/v.mrc | line 1
reconstruct {good}/tilts.mrc --angles {bad}/binary.tlt -o {out}/v.mrc | binary.tlt
reconstruct {good}/tilts.mrc --angles {bad}/short.tlt -o {out}/v.mrc | there are 2
reconstruct {good}/tilts.mrc --angles {bad}/unknown.tlt -o {out}/v.mrc | within ±720
reconstruct {good}/tilts.mrc --angles {bad}/huge.tlt -o {out}/v.mrc | within ±720
reconstruct {good}/tilts.mrc --angles {bad}/far.tlt -o {out}/v.mrc | within ±720
reconstruct {good}/tilts.mrc --angles {bad}/script.tlt -o {out}/v.mrc | is not an angle
reconstruct {good}/one-tilt.npy -o {out}/v.mrc | images are constant
reconstruct {good}/tilts.mrc --angles {bad}/same.tlt -o {out}/v.mrc | different angles
reconstruct {good}/tilts.mrc --angles {bad}/no.mdoc -o {out}/v.mrc | no angles
reconstruct {good}/tilts.mrc --angles {bad}/folder -o {out}/v.mrc | folder
reconstruct {good}/tilts.mrc --alignment {bad}/missing.xf -o {out}/v.mrc | does not exist
reconstruct {good}/tilts.mrc --alignment {bad}/wrong.xf -o {out}/v.mrc | six numbers
reconstruct {good}/tilts.mrc --alignment {bad}/short.xf -o {out}/v.mrc | 1 transforms
reconstruct {good}/tilts.mrc --method magic -o {out}/v.mrc | choose
reconstruct {good}/tilts.mrc --mode sem -o {out}/v.mrc | linear
reconstruct {good}/tilts.mrc --thickness 0 -o {out}/v.mrc | thickness
reconstruct {good}/tilts.mrc --thickness -4 -o {out}/v.mrc | thickness
reconstruct {good}/tilts.mrc --weight -1 -o {out}/v.mrc | zero or more
reconstruct {good}/tilts.mrc --weight nan -o {out}/v.mrc | zero or more
reconstruct {good}/tilts.mrc --noise-model {bad}/missing.safetensors -o {out}/v.mrc | does not exist
reconstruct {good}/tilts.mrc --noise-model {bad}/future.safetensors -o {out}/v.mrc | update noiseflow
reconstruct {good}/tilts.mrc --report {bad}/empty.mrc -o {out}/v.mrc | is a file
reconstruct {good}/tilts.mrc -o {out}/v.xyz | name it
reconstruct {good}/tilts.mrc -o {out}/none/v.mrc | create the folder
reconstruct {good}/tilts.mrc -o {out}/v.mrc --device cuda | --device cpu
compare {bad}/missing.mrc {good}/tilts.mrc | does not exist
compare {good}/tilts.mrc {good}/clean.mrc | shape
compare {bad}/nan.npy {good}/tilts.mrc | NaN
compare {good}/tilts.mrc {bad}/flat.npy | flat
compare {good}/tilts.mrc {bad}/cut.mrc | header claims
sample {good}/model.safetensors {good}/clean.mrc -o {good}/clean.mrc | also an input
sample {good}/clean.mrc {good}/model.safetensors -o {out}/n.mrc | check the order
sample {good}/model.safetensors {good}/model.safetensors -o {out}/n.mrc | is not an image but a noise model
sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.safetensors | name it
evaluate {good}/model.safetensors --signal {good}/model.safetensors --observation {good}/clean.mrc | is not an image
evaluate {bad}/pickle.safetensors --signal {good}/clean.mrc --observation {good}/clean.mrc | not a noise-model file
evaluate {good}/model.safetensors --signal {bad}/absurd.mrc --observation {good}/clean.mrc | header claims
evaluate {good}/model.safetensors --signal {good}/clean.mrc --observation {bad}/missing.mrc | does not exist
calibrate --short {good}/model.safetensors --long {good}/long.tif -o {out}/m.safetensors | a noise model
calibrate --short {good}/050ms.tif --long {good}/long.tif -o {out}/none/m.safetensors | create the folder
calibrate --short {good}/050ms.tif --long {good}/long.tif -o {good}/long.tif | name it
simulate {good} | --overwrite
simulate {out}/s --noise none --clip | --clip
simulate {out}/s --noise {good}/clean.mrc | not a noise-model file
reconstruct {good}/tilts.mrc -o {good}/tilts.mrc | also an input
reconstruct {good}/tilts.rawtlt -o {out}/v.mrc | is not an image but a file of tilt angles
reconstruct {good}/tilts.mrc --angles {good}/tilts.mrc -o {out}/v.mrc | is not a text file
reconstruct {good}/model.safetensors -o {out}/v.mrc | is not an image but a noise model
reconstruct {good}/tilts.mrc --preset magic -o {out}/v.mrc | kniesel2022
reconstruct {good}/tilts.mrc --window magic -o {out}/v.mrc | hann
reconstruct {good}/tilts.mrc --denoiser magic --method wbp-denoised -o {out}/v.mrc | nlm
reconstruct {good}/tilts.mrc --denoiser os:system: --method wbp-denoised -o {out}/v.mrc | denoiser
reconstruct {good}/tilts.mrc --mask {good}/small.mrc -o {out}/v.mrc | mask
reconstruct {good}/tilts.mrc --mask {bad}/nan.npy -o {out}/v.mrc | NaN
reconstruct {good}/tilts.mrc --reference {good}/clean.mrc -o {out}/v.mrc | clean.mrc
reconstruct {good}/tilts.mrc --reference {bad}/cut.mrc -o {out}/v.mrc | header claims
reconstruct {good}/tilts.mrc --method joint-supervised -o {out}/v.mrc | --noise-model
reconstruct {good}/tilts.mrc --method wbp --save-noise-model {out}/m.safetensors -o {out}/v.mrc | method wbp does not support it
reconstruct {good}/tilts.mrc --save-noise-model {out}/m.pt -o {out}/v.mrc | name it
reconstruct {good}/tilts.mrc --noise-model {good}/clean.mrc -o {out}/v.mrc | not a noise-model file
reconstruct {good}/tilts.mrc --fsc -o {out}/v.mrc | --report
compare {good}/tilts.mrc {good}/tilts.mrc --angles {bad}/words.tlt | line 1
compare {good}/tilts.mrc {good}/tilts.mrc --angles {good}/tilts.rawtlt --mode sem | linear
compare {good}/tilts.mrc {good}/tilts.mrc --report {bad}/empty.mrc | is a file
compare {good}/model.safetensors {good}/tilts.mrc | is not an image but a noise model
compare {bad}/absurd.mrc {good}/tilts.mrc | header claims
compare {good}/tilts.mrc {bad}/text.dm3 | cannot be read
benchmark nothing --out {out}/b | choose from
benchmark --repeats 0 --out {out}/b | at least 1
benchmark --out {bad}/empty.mrc | is a file
benchmark --size 2 --quick --out {out}/b | at least 8
benchmark --noise none --quick --out {out}/b | noise
benchmark --noise magic --quick --out {out}/b | magic
benchmark --phantom unicorn --quick --out {out}/b | unicorn
sample {good}/model.safetensors {good}/clean.mrc -o /proc/n.mrc | not writable
reconstruct {good}/tilts.mrc -o /proc/v.mrc | not writable
simulate /proc/s | not writable
sample {bad}/pipe {good}/clean.mrc -o {out}/n.mrc | is not a regular file
evaluate {bad}/pipe --signal {good}/clean.mrc --observation {good}/small.mrc | is not a regular file
reconstruct {good}/tilts.mrc --noise-model {bad}/pipe -o {out}/v.mrc | is not a regular file
reconstruct {good}/tilts.mrc --method wbp --report {out}/v.mrc -o {out}/v.mrc | another folder
reconstruct {good}/tilts.mrc --method wbp --report {out}/v.mrc/page -o {out}/v.mrc | another folder
reconstruct {good}/tilts.mrc --method wbp --tilt-axis 1e300 -o {out}/v.mrc | within ±360
reconstruct {good}/tilts.mrc --method wbp --tilt-axis nan -o {out}/v.mrc | within ±360
calibrate --short {good}/050ms.tif --long {good}/long.tif --report {out}/m.safetensors -o {out}/m.safetensors | another folder
measure {bad}/nan.npy | NaN
measure {good}/tilts.mrc --line 0,0,0:99,0,0 | leaves the volume
measure {good}/tilts.mrc --region 0:2 | --region
measure {good}/clean.mrc | three axes
batch {bad}/binary.tlt -o {out} | is not a CSV table
batch {good}/tilts.mrc -o {out} | is not a CSV table
batch {bad}/folder -o {out} | no stack with tilt angles
batch {good} -o {bad}/empty.mrc | is a file
batch {good} -o {out} --options "--method 'wbp" | --options
batch {good} -o {out} --options '-o {out}/x.mrc' | in the options
batch {good} -o {out} --options '--output={out}/x.mrc' | in the options
demo --out /proc/demo | not writable
demo --out {bad}/empty.mrc | is a file
demo --out {bad}/empty.mrc/below | empty.mrc
"""
ROWS = [tuple(row.rsplit(" | ", 1)) for row in CASES.strip().splitlines()]
USAGE = [
    "",
    "recontruct {good}/tilts.mrc -o {out}/v.mrc",
    "sample",
    "sample {good}/model.safetensors {good}/clean.mrc",
    "simulate {out}/s --size big",
    "reconstruct {good}/tilts.mrc -o {out}/v.mrc --wieght 1",
    "reconstruct {good}/tilts.mrc -o {out}/v.mrc --thickness 3.5",
    "evaluate {good}/model.safetensors --signal {good}/clean.mrc",
    "doctor --out x",
    "reconstruct {good}/tilts.mrc --steps 0 -o {out}/v.mrc",
    "reconstruct {good}/tilts.mrc --steps -5 -o {out}/v.mrc",
    "sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.mrc --seed -1",
    "sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.mrc --seed 99999999999999999999",
]
