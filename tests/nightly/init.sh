#!/bin/busybox sh
# First process of the virtual machine: mounts, loads, then runs what comes on its second serial port, a command a line.
/bin/busybox mkdir -p /proc /sys /dev /host
/bin/busybox --install -s /bin
export PATH=/bin
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for module in /modules/*.ko; do
  insmod "$module" || echo "not loaded: $module"
done
mount -t configfs configfs /sys/kernel/config
# The host's files, read-only: its Python runs here as well.
mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144,cache=loose,ro host /host || echo "no files of the host"
mkdir -p /dev/pts /dev/shm
mount --bind /dev /host/dev
mount --bind /proc /host/proc
mount --bind /sys /host/sys
mount -t tmpfs tmpfs /host/run
ip link set lo up
stty -F /dev/ttyS1 raw -echo
exec </dev/ttyS1 >/dev/ttyS1
echo "ready"
while read -r line; do
  (eval "$line") 2>&1
  echo "<ended with $?>"
done
poweroff -f
