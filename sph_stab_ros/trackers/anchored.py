# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""v1."""
import numpy as np
from scipy.spatial.transform import Rotation
from dataclasses import dataclass
from sph_stab_ros.estimators.pose import fit_pose
from sph_stab_ros.equirect import pixels_from_bearings
from sph_stab_ros.trackers.band import Band, follow
from sph_stab_ros.trackers.base import NS_PER_S, TrackedOrientation, TrackingStatus
from sph_stab_ros.trackers.still_pixels import StillPixels
from sph_stab_ros.trackers.thumbnail import align, Thumbnail
PRIOR_INFORMATION = 1.0
MEMORY = 0.8
SIGMA_DEPTH_PX = 0.5
MAX_INFORMATION = 1e4
BODY=True
YOUNG=.1
MAX_AGE=30.
CARRY_X=True
MIN_POINTS = 25
SIGMA0_PX=0.2
MIN_WEIGHT = 0.1
MIN_SURVIVORS = 0.5
MAX_PARALLAX_RAD = 0.05
CARRY_INFORMATION=0.5
GOOD_PREDICTION_RAD = np.deg2rad(0.7)
@dataclass
class Keyframe:
    image: np.ndarray
    uv: np.ndarray
    x: np.ndarray
    rho: np.ndarray
    information: np.ndarray
    number: int
    root: np.ndarray
    age: np.ndarray
class AnchoredTracker:
    def __init__(self, width, used=None, max_prediction_s=0.5):
        self._band = Band(width); self.reset()
    def reset(self):
        self._key=None; self._R_world_camera = Rotation.identity(); self._step=Rotation.identity(); self._number=0
        self.log=[]; self._still=StillPixels()
    def track(self, grey, stamp_ns):
        thumb=Thumbnail(grey)
        R=self._R_world_camera; status=TrackingStatus.OK
        if self._key is None:
            self._add(grey,R)
        else:
            R = R * align(self._thumb, thumb, self._step.inv()).inv()
            for _ in range(3):
                image=self._band.look(grey,R); fit=self._fit(image,R)
                if fit is None: break
                R = fit.R.inv()*R
                if fit.R.magnitude()<GOOD_PREDICTION_RAD: break
            if fit is None:
                status=TrackingStatus.PREDICTED; self._inl=None; self._add(grey,R)
            else:
                self._p=fit.position
                par=np.median(np.linalg.norm(self._y-self._key.x[self._idx],axis=1))
                self.log.append((self._number,len(self._idx),len(self._inl),fit.scale,par))
                if len(self._inl)<MIN_SURVIVORS*len(self._key.x) or par>MAX_PARALLAX_RAD: self._add(grey,R)
        self._step=self._R_world_camera.inv()*R
        self._still.update(grey,self._step.inv())
        self._R_world_camera=R; self._thumb=thumb
        return TrackedOrientation(R,status)
    def _fit(self,image,R):
        k=self._key
        uv,found=follow(k.image,image,k.uv,self._uv_now); found&=self._band.contains(uv)
        found&=self._allowed(self._band.bearings(uv),R)
        idx=np.flatnonzero(found)
        if len(idx)<MIN_POINTS: return None
        y=self._band.bearings(uv[idx])
        fit=fit_pose(k.x[idx],y,self._band.whitening(y,k.root[idx])*np.sqrt((k.age[idx]+YOUNG)/(k.age[idx]+1))[:,None],k.rho[idx],k.information[idx],self._p)
        ok=fit.weights>MIN_WEIGHT
        if ok.sum()<MIN_POINTS: return None
        self._y=fit.R.inv().apply(y); self._idx=idx; self._inl=idx[ok]
        k.rho[self._inl]=fit.inverse_depths[ok]
        if CARRY_X:
            z=k.x[idx]-fit.inverse_depths[:,None]*fit.position; l=np.linalg.norm(z,axis=1,keepdims=True)
            gain=np.minimum(1.,fit.weights*2)/(k.age[idx]+1)
            k.x[idx]+=(gain[:,None]*(self._y*l-z)); k.x[idx]/=np.linalg.norm(k.x[idx],axis=1,keepdims=True)
            k.age[idx]=np.minimum(k.age[idx]+1,MAX_AGE)
        noise=fit.scale*SIGMA0_PX
        k.information[self._inl]=np.minimum(np.maximum(MEMORY*k.information[self._inl],PRIOR_INFORMATION)+fit.information[ok]*min(1,noise/SIGMA_DEPTH_PX)**2,MAX_INFORMATION)
        now=self._band.pixels(self._y); now[:,0]+=np.rint((uv[idx,0]-now[:,0])/self._band.width)*self._band.width
        self._uv_now=self._uv_now.copy(); self._uv_now[idx]=now
        return fit
    def _add(self,grey,R):
        image=self._band.look(grey,R)
        c=np.empty((0,2),np.float32); rho=info=age=np.empty(0); xc=np.empty((0,3))
        if self._key is not None and self._inl is not None:
            k,i=self._key,self._inl
            c=self._uv_now[i].copy(); z=k.x[i]-k.rho[i,None]*self._p; n=np.linalg.norm(z,axis=1); xc=z/n[:,None]; age=k.age[i]
            rho=k.rho[i]/n; info=k.information[i]*n**2*CARRY_INFORMATION
            c[:,0]=(c[:,0]-48)%self._band.width+48
            s=1/max(np.median(rho),1e-3); rho=rho*s; info=info/s**2
        new=self._band.corners(image,c)
        new=new[self._allowed(self._band.bearings(new),R)]
        uv=np.concatenate((c,new)).astype(np.float32)
        xn=self._band.bearings(uv)
        if CARRY_X: xn[:len(c)]=xc
        age=np.concatenate((age,np.full(len(new),0. if self._key is not None else MAX_AGE)))
        self._key=Keyframe(image,uv,xn,np.concatenate((rho,np.ones(len(new)))),np.concatenate((info,np.full(len(new),PRIOR_INFORMATION))),self._number,self._band.root_information(image,uv),age)
        self._number+=1; self._uv_now=uv.copy(); self._p=np.zeros(3)

    def _allowed(self,bearings,R):
        if not len(bearings) or not BODY: return np.ones(len(bearings),bool)
        uv=pixels_from_bearings(R.inv().apply(bearings),160)
        i,j=np.clip(np.rint(uv[:,::-1]).astype(int),0,(79,159)).T
        return ~self._still.mask[i,j]
