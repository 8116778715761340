//! stub
use super::Gateway;
use crate::canopen::RpdoIndex;
use crate::canopen::boot::MappedPdo;
use crate::process_image::NodeIndex;
use crate::time::Now;

impl Gateway {
    pub(super) fn rpdos_started(&mut self, _at: (Now, NodeIndex)) {}
    pub(super) fn rpdos_stopped(&mut self, _at: (Now, NodeIndex)) {}
    pub(super) fn rpdo_sent(&mut self, _at: (Now, NodeIndex), _rpdo: RpdoIndex, _data: [u8; 8]) {}
    pub(super) fn rpdo_not_sent(&mut self, _at: (Now, NodeIndex), _rpdo: RpdoIndex) {}
    pub(super) fn rpdo_mapped(&mut self, _at: (Now, NodeIndex), _mapped: &MappedPdo) {}
}
