#!/bin/sh
# Takes a scan over HTTP with curl: sh scan.sh [ADDRESS [NAME]]
set -eu
url=${1:-http://127.0.0.1:8090}/v1
name=${2:-curl}

ask() {  # METHOD PATH [JSON]: prints the answer; a refusal says why, and ends the script
    curl --silent --show-error --fail-with-body --user "$name:${TOKEN:-}" --request "$1" "$url$2" \
        --header "Content-Type: application/json" ${3:+--data "$3"}
    echo
}

ask GET /state
ask POST "/control?wait_s=20" '{"lease_s": 60}'
trap 'ask DELETE /control' EXIT
ask POST /scans '{"region": {"center_m": [1e-6, 0], "size_m": [5e-7, 5e-7]}, "shape": [64, 64],
    "settings": {"tip-bias-voltage": "500 mV"}, "key": "'"$name-1"'"}'
until ask GET "/measurements/$name-1?wait_s=20" | tee measured.json | grep -v '"running"'; do :; done
scan=$(sed 's/.*"result":"\([0-9]*\)".*/\1/' measured.json)
curl --silent --show-error --fail "$url/scans/$scan/values?channel=Height" --output height.npy
curl --silent --show-error --fail "$url/scans/$scan/values?channel=Height&format=png" --output height.png
ls -l height.npy height.png
