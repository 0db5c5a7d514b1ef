
_legged() {
  # By spaces alone: readline would break a word at every '='.
  local line=${COMP_LINE:0:COMP_POINT} current previous kept
  local -a words
  read -ra words <<<"$line"
  case "$line" in *[[:space:]]) words+=("") ;; esac
  current=${words[${#words[@]} - 1]}
  previous=${words[${#words[@]} - 2]}
  COMPREPLY=()
  while IFS= read -r line; do
    COMPREPLY+=("$line")
  done < <(_legged_candidates "$current" "$previous" "$(_legged_tool "${words[@]:0:${#words[@]}-1}")")
  case "${COMPREPLY[0]}" in *. | *=) compopt -o nospace 2>/dev/null ;; esac
  # Readline puts back only what follows the last '='.
  case "$COMP_WORDBREAKS" in
    *=*)
      kept=${current%"${current##*=}"}
      COMPREPLY=("${COMPREPLY[@]#"$kept"}")
      ;;
  esac
}
complete -o default -o bashdefault -F _legged train.py play.py ./train.py ./play.py legged-train legged-play python python3
